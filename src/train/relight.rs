//! Other light on the same view: where a render keeps what each of its light groups lights, their sum with any weights is a
//! render too, of the scene lit otherwise, with the noise of as many samples. Light is linear, so nothing is approximated, and
//! no network gets to learn by heart how a view is lit. Tinted light is a weight for each colour.

use crate::{nn::Rng, planes::Planes};

/// Share of the crops that stay lit as they were rendered.
const AS_RENDERED: f32 = 0.2;

/// Standard deviation of the stops by which a group becomes brighter or darker, and of those of its tint.
const STOPS: f32 = 1.5;
const TINT_STOPS: f32 = 0.35;

/// Stops that a group becomes brighter or darker by at most: few samples go to faint light, and what they brought would be all
/// noise.
const MOST_STOPS: f32 = 3.0;

/// How bright each light group becomes, in each colour.
#[derive(Clone, Debug, PartialEq)]
pub struct Relight(Vec<[f32; 3]>);

impl Relight {
    /// A random one for `groups` groups; none where the light stays as it is. A group alone, which is all of a render, keeps its
    /// brightness and is tinted.
    pub fn draw(groups: usize, rng: &mut Rng) -> Option<Self> {
        if groups == 0 || rng.uniform() < AS_RENDERED {
            return None;
        }
        let mut stops = |deviation: f32| deviation * normal(rng);
        let gains = (0..groups).map(|_| {
            let brighter = if groups > 1 { stops(STOPS).clamp(-MOST_STOPS, MOST_STOPS) } else { 0.0 };
            [(); 3].map(|()| (brighter + stops(TINT_STOPS)).exp2())
        });
        Some(Self(gains.collect()))
    }

    /// The sum of what all groups light, (3, H, W) each.
    pub fn sum(&self, groups: &[Planes]) -> Planes {
        let mut sum = Planes::new(3, groups[0].width, groups[0].height);
        for (gains, group) in self.0.iter().zip(groups) {
            for (c, gain) in gains.iter().enumerate() {
                sum.channel_mut(c).iter_mut().zip(group.channel(c)).for_each(|(sum, v)| *sum += gain * v);
            }
        }
        sum
    }
}

/// A value of the normal distribution, as nearly as the sum of twelve even ones comes to it.
fn normal(rng: &mut Rng) -> f32 {
    (0..12).map(|_| rng.uniform()).sum::<f32>() - 6.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_are_weighed_by_colour_and_added_up() {
        let flat = |value: f32| Planes::from_vec(3, 2, 1, vec![value; 6]);
        let relight = Relight(vec![[1.0, 2.0, 0.0], [0.5, 0.5, 4.0]]);
        assert_eq!(relight.sum(&[flat(1.0), flat(2.0)]).data, [2.0, 2.0, 3.0, 3.0, 8.0, 8.0]);
    }

    #[test]
    fn brightness_changes_within_limits_where_there_is_more_than_one_group() {
        let mut rng = Rng::new(5, 0);
        let mut drawn =
            |groups| -> Vec<Relight> { (0..400).filter_map(|_| Relight::draw(groups, &mut rng)).collect() };
        let stops = |relights: &[Relight]| -> Vec<f32> {
            let green = relights.iter().flat_map(|relight| relight.0.iter().map(|gain| gain[1].log2()));
            green.collect()
        };
        let deviation =
            |values: &[f32]| (values.iter().map(|v| v * v).sum::<f32>() / values.len() as f32).sqrt();
        let three = drawn(3);
        assert!((280..360).contains(&three.len()), "{} of 400", three.len());
        assert!((1.3..1.7).contains(&deviation(&stops(&three))));
        assert!(stops(&three).iter().all(|s| s.abs() < MOST_STOPS + 6.0 * TINT_STOPS));
        assert!((0.3..0.4).contains(&deviation(&stops(&drawn(1)))));
    }
}
