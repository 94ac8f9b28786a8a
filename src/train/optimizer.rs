//! Adam over a network's parameters, by dfdx's own update, with moments that can be saved.

use dfdx::{
    tensor::{Cpu, Gradients},
    tensor_ops::AdamConfig,
};

use crate::nn::Param;

/// Adam (Kingma and Ba 2015) with its moments.
pub struct Adam {
    first: Gradients<f32, Cpu>,
    second: Gradients<f32, Cpu>,
}

/// A gradient whose norm over all parameters exceeds this is scaled down to it:
/// one firefly must not undo an hour.
const CLIP: f64 = 1.0;

impl Default for Adam {
    fn default() -> Self {
        Self { first: Gradients::leaky(), second: Gradients::leaky() }
    }
}

impl Adam {
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
        const CPU: &str = "the CPU allocates or aborts";
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
        let config = AdamConfig { lr, ..AdamConfig::default() };
        for param in params.into_iter().filter(|p| p.trainable) {
            let gradient = gradients.get_or_alloc_mut(&param.tensor).expect(CPU);
            gradient.iter_mut().for_each(|g| *g *= scale);
            let first = self.first.get_or_alloc_mut(&param.tensor).expect(CPU);
            let second = self.second.get_or_alloc_mut(&param.tensor).expect(CPU);
            let t = i32::try_from(step).expect("fewer than two billion steps");
            config.try_update(t, &mut param.tensor, first, second, gradient).expect(CPU);
        }
        norm
    }

    /// The moments of a parameter, (first, second), for a checkpoint.
    pub fn moments(&mut self, param: &Param) -> [Vec<f32>; 2] {
        [&mut self.first, &mut self.second].map(|moments| {
            moments.get_or_alloc_mut(&param.tensor).expect("the CPU allocates or aborts").to_vec()
        })
    }

    /// Restores the moments of a parameter from a checkpoint.
    ///
    /// # Panics
    /// If lengths differ.
    pub fn set_moments(&mut self, param: &Param, [first, second]: [&[f32]; 2]) {
        for (moments, values) in [(&mut self.first, first), (&mut self.second, second)] {
            let into = moments.get_or_alloc_mut(&param.tensor).expect("the CPU allocates or aborts");
            into.copy_from_slice(values);
        }
    }
}
