//! The perceptrons that judge a place of a frame by its features: two hidden layers, computed for a row of
//! places (pixels, or squares of them) at a time.

use safetensors::SafeTensors;

use crate::kernels::{
    exponential::exp,
    vectorised::{self, Vectorised},
};

/// Units of both hidden layers.
const HIDDEN: usize = 24;

/// The slope of hidden units below zero.
const LEAK: f32 = 0.1;

/// A perceptron.
pub struct Perceptron {
    first: Layer,
    second: Layer,
    last: Layer,
}

/// Weights of a layer, outputs by inputs, and biases.
struct Layer(Vec<f32>, Vec<f32>);

impl Perceptron {
    /// Reads the perceptron of a weights file that is part of the program.
    ///
    /// # Panics
    /// If the file holds a perceptron of other sizes.
    pub fn read(file: &[u8], inputs: usize, outputs: usize) -> Self {
        let file = SafeTensors::deserialize(file).expect("a test reads it");
        let tensor = |name: String, len: usize| -> Vec<f32> {
            let bytes = file.tensor(&name).expect("a test reads it").data();
            let values: Vec<f32> =
                bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
            assert_eq!(values.len(), len, "{name}");
            values
        };
        let layer = |name: &str, inputs: usize, outputs: usize| {
            Layer(tensor(format!("{name}.weight"), inputs * outputs), tensor(format!("{name}.bias"), outputs))
        };
        Self {
            first: layer("first", inputs, HIDDEN),
            second: layer("second", HIDDEN, HIDDEN),
            last: layer("last", HIDDEN, outputs),
        }
    }

    /// The weights of a row of places of a neighbour of a frame: the exponential of what the perceptron, which
    /// has one output, makes of `features`, kept between `least` and 0, less the exponential of `least`, and times that
    /// of `gate`, if there is one; 0 where `columns`, those of the places, are NaN.
    pub fn weigh(
        &self,
        features: &[f32],
        least: f32,
        gate: Option<&[f32]>,
        columns: &[f32],
        out: &mut [f32],
    ) {
        self.apply(features, columns.len(), out);
        vectorised::run(Weights { least, gate, columns, out });
    }

    /// Computes its outputs for a row of places. `input` and `output` hold a line for each input and each
    /// output.
    pub fn apply(&self, input: &[f32], places: usize, output: &mut [f32]) {
        vectorised::run(Row { perceptron: self, input, output, places });
    }
}

/// See [`Perceptron::weigh`]; `out` holds what the perceptron makes of the features.
struct Weights<'a> {
    least: f32,
    gate: Option<&'a [f32]>,
    columns: &'a [f32],
    out: &'a mut [f32],
}

impl Vectorised for Weights<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { least, gate, columns, out } = self;
        // The least weight is none: of a lamp of a thousand times the light around it, any share would show.
        let none = exp(least);
        out.iter_mut().for_each(|v| *v = exp(v.clamp(least, 0.0)) - none);
        if let Some(gate) = gate {
            out.iter_mut().zip(gate).for_each(|(v, gate)| *v *= exp(*gate));
        }
        out.iter_mut().zip(columns).for_each(|(v, column)| *v = if column.is_nan() { 0.0 } else { *v });
    }
}

/// Places that are computed together: what they need stays in the first-level cache.
const BLOCK: usize = 64;

/// A value for each place of a block.
type Line = [f32; BLOCK];

/// A row of places.
struct Row<'a> {
    perceptron: &'a Perceptron,
    input: &'a [f32],
    output: &'a mut [f32],
    places: usize,
}

impl Vectorised for Row<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { perceptron: Perceptron { first, second, last }, input, output, places } = self;
        let mut lines = vec![[0.0; BLOCK]; input.len() / places.max(1)];
        let mut results = vec![[0.0; BLOCK]; last.1.len()];
        let [mut one, mut two] = [[[0.0; BLOCK]; HIDDEN]; 2];
        for start in (0..places).step_by(BLOCK) {
            let block = start..(start + BLOCK).min(places);
            for (line, values) in lines.iter_mut().zip(input.chunks_exact(places)) {
                line[..block.len()].copy_from_slice(&values[block.clone()]);
            }
            layer(first, &lines, &mut one);
            leak(&mut one);
            layer(second, &one, &mut two);
            leak(&mut two);
            layer(last, &two, &mut results);
            for (line, values) in results.iter().zip(output.chunks_exact_mut(places)) {
                values[block.clone()].copy_from_slice(&line[..block.len()]);
            }
        }
    }
}

/// A layer of the perceptron for a block of places.
#[inline(always)]
fn layer(Layer(weights, biases): &Layer, input: &[Line], output: &mut [Line]) {
    for ((output, weights), bias) in output.iter_mut().zip(weights.chunks_exact(input.len())).zip(biases) {
        let mut sums = [*bias; BLOCK];
        for (line, weight) in input.iter().zip(weights) {
            sums.iter_mut().zip(line).for_each(|(sum, v)| *sum += weight * v);
        }
        *output = sums;
    }
}

#[inline(always)]
fn leak(lines: &mut [Line]) {
    lines.as_flattened_mut().iter_mut().for_each(|v| *v = v.max(LEAK * *v));
}
