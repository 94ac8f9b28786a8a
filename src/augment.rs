//! Changes to a frame that leave it as good a picture: flips, quarter turns, a permutation of RGB, exposure,
//! coloured light.
//!
//! A pass of vectors must change with the picture. Camera-space normals and motion turn as the image turns.
//! World space has no axis of its own: a flipped picture shows a mirrored world, a turned one shows a turned
//! world, so the same flip and turn are applied to the horizontal axes of normals and positions, about the
//! vertical one, which gravity makes special.

use crate::{
    passes::{Pass, PassSet, Quantity},
    planes::Planes,
    rng::Rng,
};

/// One drawn augmentation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Augment {
    /// Left and right change places (first).
    pub flip: bool,
    /// Counter-clockwise quarter turns (second), 0 to 3.
    pub turns: usize,
    /// Which old colour channel each new one takes.
    pub rgb: [usize; 3],
    /// Radiance is multiplied by this.
    pub exposure: f32,
    /// So is each of its channels by its own: the scene in light of this colour.
    pub tint: [f32; 3],
}

/// Every order of three channels.
const ORDERS: [[usize; 3]; 6] = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];

/// Radiance is scaled by up to two stops either way.
const STOPS: f32 = 2.0;

impl Augment {
    /// Nothing changes.
    pub const IDENTITY: Self = Self { flip: false, turns: 0, rgb: [0, 1, 2], exposure: 1.0, tint: [1.0; 3] };

    /// A random one.
    pub fn draw(rng: &mut Rng) -> Self {
        Self {
            flip: rng.below(2) == 1,
            turns: rng.below(4),
            rgb: ORDERS[rng.below(6)],
            exposure: ((2.0 * rng.uniform() - 1.0) * STOPS).exp2(),
            tint: Self::IDENTITY.tint,
        }
    }

    /// The same in coloured light, with the probability `share`. One channel stays as it is; the others keep a
    /// random part of their light, often next to none, as with a pure red.
    pub fn tinted(self, share: f64, rng: &mut Rng) -> Self {
        if share == 0.0 || f64::from(rng.uniform()) >= share {
            return self;
        }
        let mut tint = [0; 3].map(|_| rng.uniform().powi(3));
        tint[rng.below(3)] = 1.0;
        Self { tint, ..self }
    }

    /// Applied to every pass of a frame.
    ///
    /// # Panics
    /// If the frame is not square and a quarter turn is asked for.
    pub fn passes(&self, old: &PassSet) -> PassSet {
        old.map((old.width, old.height), |pass, planes| self.pass(pass, planes))
    }

    /// Applied to one pass.
    ///
    /// # Panics
    /// As [`Augment::passes`].
    pub fn pass(&self, pass: Pass, planes: &Planes) -> Planes {
        let mut planes = self.moved(planes);
        match pass.quantity() {
            Quantity::Direction | Quantity::Place => self.turn_vectors(&mut planes, 0),
            Quantity::Motion => [0, 2].into_iter().for_each(|first| self.turn_vectors(&mut planes, first)),
            Quantity::Share | Quantity::Distance => {}
            Quantity::Radiance | Quantity::Colour => {
                if self.rgb != Self::IDENTITY.rgb {
                    planes = self.permuted(&planes);
                }
            }
        }
        if pass.carries_radiance() && (self.exposure, self.tint) != (1.0, Self::IDENTITY.tint) {
            for (c, tint) in self.tint.iter().enumerate() {
                planes.channel_mut(c).iter_mut().for_each(|v| *v *= self.exposure * tint);
            }
        }
        planes
    }

    /// Moves pixels: flip, then turns.
    fn moved(&self, planes: &Planes) -> Planes {
        let (w, h) = (planes.width, planes.height);
        if (self.flip, self.turns) == (false, 2) {
            return planes.turned();
        }
        assert!(self.turns.is_multiple_of(2) || w == h, "only squares turn by a quarter");
        Planes::from_rows(planes.channels, (w, h), |c, y, row| {
            let from = planes.channel(c);
            for (x, value) in row.iter_mut().enumerate() {
                // Where the pixel that a counter-clockwise turn brings to (x, y) came from.
                let (sx, sy) = match self.turns {
                    0 => (x, y),
                    1 => (w - 1 - y, x),
                    2 => (w - 1 - x, h - 1 - y),
                    _ => (y, h - 1 - x),
                };
                *value = from[sy * w + if self.flip { w - 1 - sx } else { sx }];
            }
        })
    }

    /// Turns the vectors of two channels as the picture turned; the second of them points up.
    fn turn_vectors(&self, planes: &mut Planes, first: usize) {
        let n = planes.pixels();
        let (xs, rest) = planes.data[first * n..].split_at_mut(n);
        for (x, y) in xs.iter_mut().zip(rest) {
            if self.flip {
                *x = -*x;
            }
            (*x, *y) = match self.turns {
                0 => (*x, *y),
                1 => (-*y, *x),
                2 => (-*x, -*y),
                _ => (*y, -*x),
            };
        }
    }

    fn permuted(&self, planes: &Planes) -> Planes {
        let mut out = planes.clone();
        for (to, &from) in self.rgb.iter().enumerate() {
            out.channel_mut(to).copy_from_slice(planes.channel(from));
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(values: Vec<f32>) -> Planes {
        Planes::from_vec(values.len() / 4, 2, 2, values)
    }

    #[test]
    fn a_turn_moves_right_to_top_and_turns_vectors_with_it() {
        let turn = Augment { turns: 1, ..Augment::IDENTITY };
        // The top right pixel goes to the top left; a normal to the right becomes one upward.
        let moved = turn.moved(&square(vec![1.0, 2.0, 3.0, 4.0]));
        assert_eq!(moved.data, [2.0, 4.0, 1.0, 3.0]);
        let normal = square([vec![1.0; 4], vec![0.0; 4], vec![0.5; 4]].concat());
        let turned = turn.pass(Pass::DenoisingNormal, &normal);
        assert_eq!([turned.data[0], turned.data[4], turned.data[8]], [0.0, 1.0, 0.5]);
    }

    #[test]
    fn four_turns_and_two_flips_are_the_identity() {
        let start = square((0..12).map(|v| v as f32).collect());
        let turn = Augment { turns: 1, ..Augment::IDENTITY };
        let flip = Augment { flip: true, ..Augment::IDENTITY };
        let turned = (0..4).fold(start.clone(), |p, _| turn.pass(Pass::Normal, &p));
        let flipped = (0..2).fold(start.clone(), |p, _| flip.pass(Pass::Normal, &p));
        assert_eq!((turned, flipped), (start.clone(), start));
    }

    /// Pixel (x, y), y downwards, was at (x + X, y - Y) one frame before and will be at (x - Z, y + W) one
    /// later.
    #[test]
    fn motion_leads_to_the_same_places_of_a_picture_that_was_flipped_and_turned() {
        const SIDE: usize = 5;
        let plane = |values: [f32; SIDE * SIDE]| Planes::from_vec(1, SIDE, SIDE, values.into());
        let marks = |at: usize| plane(std::array::from_fn(|i| if i == at { 1.0 } else { 0.0 }));
        let place = |planes: &Planes| planes.data.iter().position(|v| *v == 1.0).expect("a mark stays one");
        // What is at column 3, row 1 was at 1, 0 and will be at 4, 4.
        let at = |x: usize, y: usize| marks(y * SIDE + x);
        let [before, now, later] = [at(1, 0), at(3, 1), at(4, 4)];
        let motion = [-2.0, 1.0, -1.0, 3.0].map(|v| [v; SIDE * SIDE]).concat();
        let motion = Planes::from_vec(4, SIDE, SIDE, motion);
        for (flip, turns) in (0..8).map(|i| (i >= 4, i % 4)) {
            let augment = Augment { flip, turns, ..Augment::IDENTITY };
            let changed = augment.pass(Pass::Vector, &motion);
            let [before, now, later] = [&before, &now, &later].map(|marks| place(&augment.moved(marks)));
            let [x, y, z, w] = std::array::from_fn(|c| changed.channel(c)[now] as isize);
            let from = |columns: isize, rows: isize| {
                let (column, row) = ((now % SIDE) as isize + columns, (now / SIDE) as isize + rows);
                (row * SIDE as isize + column) as usize
            };
            assert_eq!((from(x, -y), from(-z, w)), (before, later), "flip {flip}, {turns} turns");
        }
    }

    #[test]
    fn as_many_are_tinted_as_asked_for_and_one_channel_stays() {
        let rng = &mut Rng::new(1, 2);
        let tints: Vec<[f32; 3]> = (0..1000).map(|_| Augment::IDENTITY.tinted(0.25, rng).tint).collect();
        let tinted = tints.iter().filter(|tint| **tint != [1.0; 3]).count();
        assert!((200..300).contains(&tinted), "{tinted} of 1000");
        assert!(tints.iter().all(|tint| tint.contains(&1.0) && tint.iter().all(|v| (0.0..=1.0).contains(v))));
        assert_eq!(Augment::IDENTITY.tinted(0.0, rng), Augment::IDENTITY);
    }

    #[test]
    fn colours_permute_together_and_only_radiance_is_exposed_and_tinted() {
        let augment = Augment { rgb: [2, 0, 1], exposure: 4.0, tint: [1.0, 0.5, 0.0], ..Augment::IDENTITY };
        let colours = square([vec![1.0; 4], vec![2.0; 4], vec![3.0; 4]].concat());
        let pick = |p: Planes| [p.data[0], p.data[4], p.data[8]];
        assert_eq!(pick(augment.pass(Pass::Combined, &colours)), [12.0, 2.0, 0.0]);
        assert_eq!(pick(augment.pass(Pass::DenoisingAlbedo, &colours)), [3.0, 1.0, 2.0]);
    }
}
