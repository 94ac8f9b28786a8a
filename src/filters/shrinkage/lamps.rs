//! Tells how bright a pixel beside a lamp can be which none of its samples met.
//!
//! No weight of a kernel is exactly zero, so a hundred-thousandth of a lamp, of a screen or of the sun comes into the
//! pixels beside it. That may be a hundred times the light that is there, and of many samples it is no antialiasing:
//! one of them would have met the lamp. Of few it may be, so that they count as light that is seen directly does.

use rayon::prelude::*;

use super::{Render, grown};

/// Light that is seen directly is in the albedo, and no surface has more than white.
const BEYOND_WHITE: f32 = 1.05;

/// So many of the 8 pixels around one that is beyond white have to be so as well for it to be of a lamp: others may be
/// sparks in a mirror, which tell nothing of the pixels beside them.
const COMPANY: usize = 3;

/// A pixel lies beside a lamp if that is so many rows and columns away, and is held against pixels of that distance.
const REACH: usize = 2;

/// It may be this many times as bright as the brightest of them, the lamp left aside.
const MOST: f32 = 1.5;

/// The lamps of a frame.
pub struct Lamps<'a> {
    render: &'a Render<'a>,
    is_lamp: Vec<bool>,
    is_beside: Vec<bool>,
}

impl<'a> Lamps<'a> {
    /// The lamps of a frame, if it has any.
    pub fn of(render: &'a Render<'a>) -> Option<Self> {
        let albedo = render.albedo;
        let (width, height) = (albedo.width, albedo.height);
        let [red, green, blue] = [0, 1, 2].map(|c| albedo.channel(c));
        let colours = red.par_iter().zip(green).zip(blue);
        let beyond: Vec<bool> = colours.map(|((r, g), b)| r.max(*g).max(*b) > BEYOND_WHITE).collect();
        if !beyond.contains(&true) {
            return None;
        }
        let has_company = |at: usize| {
            let around = albedo.near(at % width, at / width, 1).filter(|(x, y)| beyond[y * width + x]);
            around.count() > COMPANY // itself among them
        };
        let is_lamp: Vec<bool> =
            beyond.par_iter().enumerate().map(|(at, beyond)| *beyond && has_company(at)).collect();
        let mut is_beside = grown(&is_lamp, (width, height), REACH);
        is_beside.par_iter_mut().zip(&beyond).for_each(|(is, beyond)| *is &= !beyond);
        Some(Self { render, is_lamp, is_beside })
    }

    /// The most light that a pixel beside a lamp can have, as the sum of its colours; nothing of other pixels.
    pub fn most_beside(&self, x: usize, y: usize) -> Option<f32> {
        let radiance = self.render.radiance;
        let at = |(x, y): (usize, usize)| y * radiance.width + x;
        if !self.is_beside[at((x, y))] {
            return None;
        }
        let light = |at: usize| (0..3).map(|c| radiance.channel(c)[at].max(0.0)).sum();
        let others = radiance.near(x, y, REACH).map(at).filter(|at| !self.is_lamp[*at]);
        Some(MOST * others.map(light).fold(0.0, f32::max))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::planes::Planes;

    const SIZE: (usize, usize) = (24, 20);

    fn planes(value: impl Fn(usize, usize) -> f32 + Sync) -> Planes {
        Planes::from_rows(3, SIZE, |_, y, row| {
            row.iter_mut().enumerate().for_each(|(x, v)| *v = value(x, y));
        })
    }

    #[test]
    fn the_most_is_told_beside_what_is_beyond_white_in_company() {
        // A lamp of 4x4 pixels on a wall, of which one pixel is brighter, and a spark.
        let is_lamp = |x: usize, y: usize| (4..8).contains(&x) && (6..10).contains(&y);
        let spark = (15, 15);
        let radiance = planes(|x, y| match (x, y) {
            _ if is_lamp(x, y) || (x, y) == spark => 50.0,
            (3, 7) => 0.5,
            _ => 0.25,
        });
        let albedo = planes(|x, y| if is_lamp(x, y) || (x, y) == spark { 50.0 } else { 0.75 });
        let render = Render { radiance: &radiance, albedo: &albedo, exposure: 1.0, samples: None };
        let lamps = Lamps::of(&render).unwrap();
        for y in 0..SIZE.1 {
            for x in 0..SIZE.0 {
                let is_beside = (2..10).contains(&x) && (4..12).contains(&y) && !is_lamp(x, y);
                let is_near_brighter = x <= 5 && (5..10).contains(&y);
                let most = 1.5 * 3.0 * if is_near_brighter { 0.5 } else { 0.25 };
                assert_eq!(lamps.most_beside(x, y), is_beside.then_some(most), "{x}, {y}");
            }
        }
        let dull = planes(|_, _| 1.0);
        assert!(Lamps::of(&Render { albedo: &dull, ..render }).is_none());
    }
}
