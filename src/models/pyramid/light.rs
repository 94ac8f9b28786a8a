//! Light on its way through the built-in network: radiance is divided by an albedo, filtered and multiplied
//! by the albedo again, and so are the layers that are denoised along with it.

use std::ops::Range;

use dfdx::tensor::NoneTape;

use super::{
    bands::{Field, Filtered, Subject, of_planes},
    trunk::Finish,
};
use crate::{companion::Kind, features::LightInputs, nn::Line, planes::Planes};

/// Rows of radiance and its companions. Results are returned in this order, each (3, R, W): exposed radiance,
/// the normal, what radiance was divided by, and the companions.
pub struct LightImages {
    /// Radiance over the divisor of the clean albedo, and the logarithm of that divisor over the one of the
    /// noisy albedo. They are kept until the network says how far to divide by either.
    quotient: Line<Field>,
    ratio: Line<Field>,
    /// Companions, kept until then as well. They are the images of each scale after the first.
    companions: Vec<(Kind, Line<Field>)>,
    /// What normals tell of the light, kept until the network says how far to follow it.
    shading: Line<Field>,
    divisor: Line<Field>,
    /// The denoised normal, for a refit.
    normal: Line<Field>,
}

impl LightImages {
    /// For a frame of `height` rows.
    pub fn new(height: usize, companions: &[Kind]) -> Self {
        let line = || Line::new(height);
        Self {
            quotient: line(),
            ratio: line(),
            companions: companions.iter().map(|kind| (*kind, line())).collect(),
            shading: line(),
            divisor: line(),
            normal: line(),
        }
    }
}

impl Subject for LightImages {
    /// Companions are divided as radiance is.
    type Inputs = (LightInputs, Vec<Planes>);

    fn images(&self) -> usize {
        1 + self.companions.len()
    }

    fn push(&mut self, (inputs, companions): Self::Inputs, _: &mut [Filtered]) -> [Planes; 2] {
        let LightInputs { light, divisor, encoded, guide, ratio, shading, normal } = inputs;
        self.quotient.push(of_planes(light));
        self.divisor.push(of_planes(divisor));
        self.ratio.push(of_planes(ratio));
        self.shading.push(of_planes(shading));
        self.normal.push(of_planes(normal));
        let lines = self.companions.iter_mut().zip(companions);
        lines.for_each(|((_, line), planes)| line.push(of_planes(planes)));
        [encoded, guide]
    }

    fn predicted(&mut self, rows: Range<usize>, finish: Finish<NoneTape>, images: &mut [Filtered]) -> Field {
        let (by_noisy, shade) = finish.refined.expect("its head has planes for both");
        let ratio = self.ratio.rows(rows.clone());
        let (beauty, others) = images.split_first_mut().expect("radiance comes first");
        for (filtered, (kind, line)) in others.iter_mut().zip(&self.companions) {
            let planes = line.rows(rows.clone());
            filtered.image.push(match kind {
                Kind::Light | Kind::Colour => planes.redivide(ratio.fork(), by_noisy.fork()),
                Kind::Share => planes,
            });
        }
        beauty.image.push(self.quotient.rows(rows.clone()).redivide(ratio, by_noisy));
        finish.gain.plus_product(self.shading.rows(rows), shade)
    }

    fn finish(&self, rows: Range<usize>, filtered: Vec<Field>, gain: Field) -> Vec<Field> {
        let [normal, divisor] = [&self.normal, &self.divisor].map(|line| line.rows(rows.clone()));
        let mut filtered = filtered.into_iter();
        let image = filtered.next().expect("radiance comes first");
        let companions = filtered.zip(&self.companions).map(|(planes, (kind, _))| match kind {
            Kind::Light => planes.product(divisor.fork()).amplify(gain.fork()),
            Kind::Colour => planes.product(divisor.fork()),
            Kind::Share => planes,
        });
        let companions: Vec<Field> = companions.collect();
        let beauty = [image.product(divisor.fork()).amplify(gain), normal, divisor];
        beauty.into_iter().chain(companions).collect()
    }

    fn forget(&mut self, predicted: usize, finished: usize) {
        let waiting = [&mut self.quotient, &mut self.ratio, &mut self.shading];
        let companions = self.companions.iter_mut().map(|(_, line)| line);
        waiting.into_iter().chain(companions).for_each(|line| line.forget(predicted));
        self.divisor.forget(finished);
        self.normal.forget(finished);
    }
}
