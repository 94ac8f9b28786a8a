//! The optimisers, over a network's parameters, with moments that can be saved.

use dfdx::{
    shapes::Axes2,
    tensor::{Cpu, Gradients, Tensor, TensorFromVec},
    tensor_ops::{AdamConfig, PermuteTo, TryMatMul, WeightDecay},
};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::nn::Param;

/// How gradients become updates.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Rule {
    /// Adam (Kingma and Ba 2015), by dfdx's own update: what the papers' networks were trained with.
    #[default]
    Adam,
    /// Muon (Jordan et al. 2024) for the weights of hidden convolutions, seen as matrices of outputs by
    /// inputs and taps: the momentum is made orthogonal, so that a few directions cannot take up a whole
    /// step. Updates have the size of Adam's (Liu et al. 2025), so the same learning rates serve. Biases, and
    /// heads, whose outputs are not features, are updated by Adam.
    Muon,
}

impl Rule {
    /// Every rule, for the command line.
    pub const ALL: [Rule; 2] = [Rule::Adam, Rule::Muon];
}

impl std::fmt::Display for Rule {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Rule::Adam => "adam",
            Rule::Muon => "muon",
        })
    }
}

/// A rule and its moments.
pub struct Optimizer {
    rule: Rule,
    weight_decay: f64,
    first: Gradients<f32, Cpu>,
    /// Stays zero for parameters that Muon updates, which needs no second moments.
    second: Gradients<f32, Cpu>,
}

/// A gradient whose norm over all parameters exceeds this is scaled down to it:
/// one firefly must not undo an hour.
const CLIP: f64 = 1.0;

/// Weight of the past in Muon's momentum.
const MOMENTUM: f32 = 0.95;

/// Root mean square of an update by Muon at a learning rate of 1: about Adam's.
const UPDATE_SIZE: f32 = 0.2;

const CPU: &str = "the CPU allocates or aborts";

impl Optimizer {
    /// An optimiser whose moments are zero. Each step takes the share `weight_decay` times the learning rate
    /// off the weights of hidden convolutions (Loshchilov and Hutter 2019). Without that, what Muon's updates
    /// add up to where a gradient is nothing but noise would stay, since they are equally long there.
    pub fn new(rule: Rule, weight_decay: f64) -> Self {
        Self { rule, weight_decay, first: Gradients::leaky(), second: Gradients::leaky() }
    }

    /// One update; `step` counts from 1. Returns the norm of the gradient before clipping.
    ///
    /// # Panics
    /// Never: allocation on the CPU does not fail short of aborting.
    pub fn update(
        &mut self,
        step: usize,
        lr: f64,
        params: Vec<&mut Param>,
        gradients: &mut Gradients<f32, Cpu>,
    ) -> f64 {
        let mut squares = 0.0;
        for param in params.iter().filter(|p| p.trainable) {
            let gradient = gradients.get_or_alloc_mut(&param.tensor).expect(CPU);
            squares += gradient.iter().map(|&g| f64::from(g).powi(2)).sum::<f64>();
        }
        let norm = squares.sqrt();
        // A step without a finite gradient is skipped whole.
        if !norm.is_finite() {
            return norm;
        }
        let scale = (CLIP / norm.max(CLIP)) as f32;
        let mut matrices: Vec<(&mut Param, Vec<f32>)> = Vec::new();
        for param in params.into_iter().filter(|p| p.trainable) {
            let gradient = gradients.get_or_alloc_mut(&param.tensor).expect(CPU);
            gradient.iter_mut().for_each(|g| *g *= scale);
            let first = self.first.get_or_alloc_mut(&param.tensor).expect(CPU);
            if self.rule == Rule::Muon && param.hidden {
                let nesterov = first.iter_mut().zip(gradient.iter()).map(|(m, g)| {
                    *m = MOMENTUM * *m + g;
                    MOMENTUM * *m + g
                });
                let direction = nesterov.collect();
                // Where the gradient is zero, as when ReLUs cut off all that a layer feeds, there is no step:
                // momentum fades but keeps its direction, and steps of full length would go on that way for
                // ever.
                if gradient.iter().any(|g| *g != 0.0) {
                    matrices.push((param, direction));
                }
                continue;
            }
            let second = self.second.get_or_alloc_mut(&param.tensor).expect(CPU);
            let t = i32::try_from(step).expect("fewer than two billion steps");
            let weight_decay = param.hidden.then_some(WeightDecay::Decoupled(self.weight_decay));
            let config = AdamConfig { lr, weight_decay, ..AdamConfig::default() };
            config.try_update(t, &mut param.tensor, first, second, gradient).expect(CPU);
        }
        let kept = 1.0 - (lr * self.weight_decay) as f32;
        matrices.into_par_iter().for_each(|(param, direction)| {
            let (rows, columns) = (param.shape[0], param.shape[1..].iter().product::<usize>());
            let rate = lr as f32 * UPDATE_SIZE * (rows.max(columns) as f32).sqrt();
            let update = orthogonal(direction, rows, columns);
            let values: Vec<f32> =
                param.values().iter().zip(&update).map(|(v, u)| kept * v - rate * u).collect();
            param.set(&values);
        });
        norm
    }

    /// The moments of a parameter, (first, second), for a checkpoint.
    pub fn moments(&mut self, param: &Param) -> [Vec<f32>; 2] {
        [&mut self.first, &mut self.second]
            .map(|moments| moments.get_or_alloc_mut(&param.tensor).expect(CPU).to_vec())
    }

    /// Restores the moments of a parameter from a checkpoint.
    ///
    /// # Panics
    /// If lengths differ.
    pub fn set_moments(&mut self, param: &Param, [first, second]: [&[f32]; 2]) {
        for (moments, values) in [(&mut self.first, first), (&mut self.second, second)] {
            moments.get_or_alloc_mut(&param.tensor).expect(CPU).copy_from_slice(values);
        }
    }
}

/// Roughly the orthogonal matrix nearest to a row-major one. The Newton-Schulz iteration with Jordan's
/// coefficients, which make small singular values grow fastest, brings every singular value to about 0.7 to
/// 1.2.
fn orthogonal(matrix: Vec<f32>, rows: usize, columns: usize) -> Vec<f32> {
    const ITERATIONS: usize = 5;
    const COEFFICIENTS: [f32; 3] = [3.4445, -4.7750, 2.0315];
    type Matrix = Tensor<(usize, usize), f32, Cpu>;
    let transposed = |m: Matrix| m.permute::<_, Axes2<1, 0>>();
    let norm = matrix.iter().map(|v| v * v).sum::<f32>().sqrt().max(f32::MIN_POSITIVE);
    let mut x: Matrix = Cpu::default().tensor_from_vec(matrix, (rows, columns)) / norm;
    // The matrix products are smaller where the matrix has no more rows than columns.
    let tall = rows > columns;
    if tall {
        x = transposed(x);
    }
    // Each iteration multiplies by `a + b G + c G^2`, `G` the matrix times its transpose, and so `G` by the
    // square of that. All but two products are then of small square matrices.
    let [a, b, c] = COEFFICIENTS;
    let mut gram: Matrix = x.clone().matmul(transposed(x.clone()));
    let side = rows.min(columns);
    let unit = (0..side * side).map(|i| if i % (side + 1) == 0 { 1.0 } else { 0.0 }).collect();
    let mut product: Matrix = Cpu::default().tensor_from_vec(unit, (side, side));
    for left in (0..ITERATIONS).rev() {
        let polynomial: Matrix = gram.clone() * b + gram.clone().matmul(gram.clone()) * c;
        let apply = |m: Matrix| polynomial.clone().matmul(m.clone()) + m * a;
        product = apply(product);
        if left > 0 {
            gram = apply(apply(gram));
        }
    }
    x = product.matmul(x);
    if tall { transposed(x) } else { x }.as_vec()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;

    #[test]
    fn orthogonal_keeps_directions_and_evens_their_lengths() {
        for (rows, columns) in [(6, 20), (20, 6)] {
            // Two orthogonal directions, one a hundred times longer than the other.
            let mut rng = Rng::new(7, 1);
            let mut unit = |n: usize, even: usize| -> Vec<f32> {
                let v: Vec<f32> =
                    (0..n).map(|i| if i % 2 == even { rng.uniform() - 0.5 } else { 0.0 }).collect();
                let length = v.iter().map(|v| v * v).sum::<f32>().sqrt();
                v.iter().map(|v| v / length).collect()
            };
            let pairs = [0, 1].map(|even| (unit(rows, even), unit(columns, even)));
            let lengths = [1.0, 0.01];
            let value = |i: usize| -> f32 {
                let (r, c) = (i / columns, i % columns);
                pairs.iter().zip(lengths).map(|((u, v), s)| s * u[r] * v[c]).sum()
            };
            let matrix: Vec<f32> = (0..rows * columns).map(value).collect();
            let out = orthogonal(matrix.clone(), rows, columns);
            let mut rest = out.clone();
            for (u, v) in &pairs {
                let place = |i: usize| u[i / columns] * v[i % columns];
                let length: f32 = out.iter().enumerate().map(|(i, o)| o * place(i)).sum();
                assert!((0.6..1.3).contains(&length), "{rows}x{columns}: {length}");
                rest.iter_mut().enumerate().for_each(|(i, o)| *o -= length * place(i));
            }
            assert!(rest.iter().all(|v| v.abs() < 1e-3), "nothing else appears");
            let scaled = orthogonal(matrix.iter().map(|v| 1e-4 * v).collect(), rows, columns);
            assert!(scaled.iter().zip(&out).all(|(a, b)| (a - b).abs() < 1e-3));
        }
    }

    #[test]
    fn products_of_small_matrices_make_what_the_iteration_makes() {
        for (rows, columns) in [(48, 432), (432, 48), (32, 32)] {
            let mut rng = Rng::new(8, 1);
            // Directions from much to little, as gradients have them.
            let value = |i: usize| (rng.uniform() - 0.5) / (1 + i / columns % 40).pow(2) as f32;
            let matrix: Vec<f32> = (0..rows * columns).map(value).collect();
            let norm = matrix.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
            let mut x: Vec<f64> = matrix.iter().map(|v| f64::from(*v) / norm).collect();
            for _ in 0..5 {
                // x (a + b x'x + c (x'x)^2), one product with x'x at a time.
                let gram: Vec<f64> = (0..columns * columns)
                    .map(|i| {
                        (0..rows).map(|r| x[r * columns + i / columns] * x[r * columns + i % columns]).sum()
                    })
                    .collect();
                let times_gram = |x: &[f64]| -> Vec<f64> {
                    let mut product = vec![0.0; rows * columns];
                    for (row, out) in x.chunks(columns).zip(product.chunks_mut(columns)) {
                        for (v, gram) in row.iter().zip(gram.chunks(columns)) {
                            out.iter_mut().zip(gram).for_each(|(out, g)| *out += v * g);
                        }
                    }
                    product
                };
                let (once, twice) = (times_gram(&x), times_gram(&times_gram(&x)));
                let terms = x.iter().zip(&once).zip(&twice);
                x = terms.map(|((x, once), twice)| 3.4445 * x - 4.7750 * once + 2.0315 * twice).collect();
            }
            let out = orthogonal(matrix, rows, columns);
            let most = out.iter().zip(&x).map(|(o, x)| (f64::from(*o) - x).abs()).fold(0.0, f64::max);
            assert!(most < 5e-3, "{rows}x{columns}: {most}");
        }
    }

    #[test]
    fn muon_takes_steps_of_one_size_against_the_gradient_and_keeps_on() {
        let mut param = Param::new(&Cpu::default(), "layer".into(), &[3, 4], vec![0.0; 12]);
        param.hidden = true;
        let mut optimizer = Optimizer::new(Rule::Muon, 0.0);
        let mut step = |step, at: usize, gradient: f32| {
            let before = param.values();
            let mut gradients = Gradients::leaky();
            gradients.get_or_alloc_mut(&param.tensor).unwrap()[at] = gradient;
            optimizer.update(step, 0.1, vec![&mut param], &mut gradients);
            param.values().iter().zip(before).map(|(after, before)| after - before).collect::<Vec<f32>>()
        };
        // As long as Adam's update of a matrix of four columns: the singular value becomes 0.7 to 1.2.
        let full = 0.1 * UPDATE_SIZE * 2.0;
        let change = step(1, 0, 0.5);
        assert!((0.6 * full..1.3 * full).contains(&-change[0]), "{change:?}");
        assert!(change[1..].iter().all(|v| v.abs() < 1e-3 * full), "{change:?}");
        // A small gradient elsewhere leaves most of the momentum.
        let change = step(2, 5, 0.005);
        assert!(-change[0] > 0.6 * full, "{change:?}");
        assert!(change[5] < 0.0, "{change:?}");
    }

    #[test]
    fn long_gradients_are_cut_to_length_one() {
        let mut param = Param::new(&Cpu::default(), "layer".into(), &[4], vec![0.0; 4]);
        let mut optimizer = Optimizer::new(Rule::Adam, 0.0);
        let mut gradients = Gradients::leaky();
        gradients.get_or_alloc_mut(&param.tensor).unwrap().copy_from_slice(&[6e5, 0.0, 8e5, 0.0]);
        assert!((optimizer.update(1, 0.1, vec![&mut param], &mut gradients) - 1e6).abs() < 1.0);
        // Adam's first moment takes a tenth of it.
        let [first, _] = optimizer.moments(&param);
        for (moment, want) in first.iter().zip([0.06, 0.0, 0.08, 0.0]) {
            assert!((moment - want).abs() < 1e-6, "{first:?}");
        }
    }

    #[test]
    fn momentum_alone_moves_nothing() {
        let values: Vec<f32> = (1..=12).map(|v| v as f32).collect();
        let mut param = Param::new(&Cpu::default(), "layer".into(), &[3, 4], values.clone());
        param.hidden = true;
        let mut optimizer = Optimizer::new(Rule::Muon, 0.0);
        let mut step = |step, gradient: f32| {
            let mut gradients = Gradients::leaky();
            gradients.get_or_alloc_mut(&param.tensor).unwrap()[0] = gradient;
            optimizer.update(step, 0.1, vec![&mut param], &mut gradients);
            param.values()
        };
        let moved = step(1, 1.0);
        assert_ne!(moved, values);
        assert_eq!(step(2, 0.0), moved);
        assert_ne!(step(3, 1.0), moved);
    }

    #[test]
    fn decay_takes_a_share_of_hidden_weights_alone() {
        let before: Vec<f32> = (1..=12).map(|v| v as f32).collect();
        let after = |rule, hidden, decay| {
            let param = Param::new(&Cpu::default(), "layer".into(), &[3, 4], before.clone());
            let mut param = Param { hidden, ..param };
            let mut gradients = Gradients::leaky();
            gradients.get_or_alloc_mut(&param.tensor).unwrap()[0] = 1.0;
            Optimizer::new(rule, decay).update(1, 0.1, vec![&mut param], &mut gradients);
            param.values()
        };
        for rule in Rule::ALL {
            let kept = after(rule, true, 0.0);
            let shrunk = after(rule, true, 0.5);
            let mut shares = before.iter().zip(kept.iter().zip(&shrunk)).map(|(b, (k, s))| (k - s) / b);
            assert!(shares.all(|share| (share - 0.05).abs() < 1e-5), "{rule}: {shrunk:?}");
            assert_eq!(after(rule, false, 0.5), after(rule, false, 0.0), "{rule}");
        }
    }

    #[test]
    fn a_zero_gradient_moves_nothing() {
        assert!(orthogonal(vec![0.0; 12], 3, 4).iter().all(|v| *v == 0.0));
    }
}
