//! The perceptrons that judge a place of a frame by its features: two hidden layers, computed for a row of
//! places (pixels, or squares of them) at a time.

use safetensors::SafeTensors;

use crate::kernels::vectorised::{self, Vectorised};

/// Units of both hidden layers.
const HIDDEN: usize = 24;

/// The slope of hidden units below zero.
const LEAK: f32 = 0.1;

/// A perceptron.
pub struct Perceptron {
    first: Weights,
    second: Weights,
    last: Weights,
}

/// Weights of a layer, outputs by inputs, and biases.
struct Weights(Vec<f32>, Vec<f32>);

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
            Weights(
                tensor(format!("{name}.weight"), inputs * outputs),
                tensor(format!("{name}.bias"), outputs),
            )
        };
        Self {
            first: layer("first", inputs, HIDDEN),
            second: layer("second", HIDDEN, HIDDEN),
            last: layer("last", HIDDEN, outputs),
        }
    }

    /// Computes its outputs for a row of squares. `input` and `output` hold a line for each input and each
    /// output.
    pub fn apply(&self, input: &[f32], squares: usize, output: &mut [f32]) {
        let mut hidden = [(); 2].map(|()| vec![0.0; HIDDEN * squares]);
        let [one, two] = &mut hidden;
        vectorised::run(Layer { weights: &self.first, input, output: one, squares });
        leak(one);
        vectorised::run(Layer { weights: &self.second, input: one, output: two, squares });
        leak(two);
        vectorised::run(Layer { weights: &self.last, input: two, output, squares });
    }
}

fn leak(values: &mut [f32]) {
    values.iter_mut().for_each(|v| *v = v.max(LEAK * *v));
}

/// A layer of a perceptron for a row of squares.
struct Layer<'a> {
    weights: &'a Weights,
    input: &'a [f32],
    output: &'a mut [f32],
    squares: usize,
}

impl Vectorised for Layer<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { weights: Weights(weights, biases), input, output, squares } = self;
        let inputs = weights.len() / biases.len();
        let units = output.chunks_exact_mut(squares).zip(weights.chunks_exact(inputs)).zip(biases);
        for ((output, weights), bias) in units {
            output.fill(*bias);
            for (line, weight) in input.chunks_exact(squares).zip(weights) {
                output.iter_mut().zip(line).for_each(|(sum, v)| *sum += weight * v);
            }
        }
    }
}
