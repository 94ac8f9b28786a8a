//! One colour for each method, the same in every chart of a report.
//!
//! Families share a hue, so that a reader sees whose method a point or bar is before reading its
//! name; within a family the shades run from light to dark in the order of the methods. The hues are
//! told apart with normal and with red-green deficient sight (Okabe and Ito, "Color Universal
//! Design", 2008).

use plotters::prelude::RGBColor;

use crate::models::{
    catalogue::{self, Family},
    without_variant,
};

/// Text and axes.
pub const INK: RGBColor = RGBColor(35, 35, 40);
/// Lines of the grid.
pub const GRID: RGBColor = RGBColor(228, 228, 232);
/// Text that explains.
pub const FAINT: RGBColor = RGBColor(120, 120, 130);
/// The noisy input.
pub const NOISY_GREY: RGBColor = RGBColor(165, 165, 170);

/// Whether a method is one of this project's own.
pub fn is_own(name: &str) -> bool {
    family(name) == Family::Own
}

/// The family of a method by its name, whatever its variant (`kpcn:f32`). A name that is not in the catalogue is a weights
/// file and counts as own.
fn family(name: &str) -> Family {
    catalogue::find(without_variant(name)).map_or(Family::Own, |method| method.family)
}

fn hue(family: Family) -> RGBColor {
    match family {
        Family::Noisy => NOISY_GREY,
        Family::Paper => RGBColor(0, 158, 115),
        Family::Rival => RGBColor(190, 90, 150),
        Family::Oidn => RGBColor(213, 94, 0),
        Family::Own => RGBColor(0, 114, 178),
    }
}

/// The colours of `names`, in their order.
pub fn colours<S: AsRef<str>>(names: &[S]) -> Vec<RGBColor> {
    let families: Vec<Family> = names.iter().map(|n| family(n.as_ref())).collect();
    let shade = |at: usize| {
        let family = families[at];
        let members = families.iter().filter(|f| **f == family).count();
        let rank = families[..at].iter().filter(|f| **f == family).count();
        if family == Family::Noisy || members == 1 {
            return hue(family);
        }
        // The first is mixed with 40 % of white, the last with 35 % of black.
        let place = 0.4 - 0.75 * rank as f64 / (members - 1) as f64;
        let target = if place > 0.0 { RGBColor(255, 255, 255) } else { RGBColor(0, 0, 0) };
        mix(hue(family), target, place.abs())
    };
    (0..names.len()).map(shade).collect()
}

/// The colour in which a method's name can be read on white.
pub fn legible(colour: RGBColor) -> RGBColor {
    mix(colour, INK, 0.45)
}

/// The colour a share of the way from one to another.
pub fn mix(a: RGBColor, b: RGBColor, share: f64) -> RGBColor {
    let channel = |a: u8, b: u8| (f64::from(a) + (f64::from(b) - f64::from(a)) * share).round() as u8;
    RGBColor(channel(a.0, b.0), channel(a.1, b.1), channel(a.2, b.2))
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;

    #[test]
    fn variants_are_of_their_methods_family() {
        assert!(
            ["demc-s:temporal", "demc-m:unrestrained", "run/best.safetensors:f32"].into_iter().all(is_own)
        );
        assert!(["lbf:f32", "kpcn:bf16", "noisy"].into_iter().all(|name| !is_own(name)));
    }

    #[test]
    fn every_method_of_the_contract_has_a_colour_of_its_own() {
        let names = "noisy demc-s demc-m demc-l demc demc-nofusion semc kpcn nfor lbf oidn-fast \
                     oidn-balanced oidn-high oidn-high-prefilter run/best";
        let names: Vec<&str> = names.split_whitespace().collect();
        let found = colours(&names);
        let distinct: HashSet<_> = found.iter().map(|c| (c.0, c.1, c.2)).collect();
        assert_eq!(distinct.len(), names.len());
        let luminance = |c: RGBColor| {
            let linear = |v: u8| (f64::from(v) / 255.0).powf(2.2);
            0.2126 * linear(c.0) + 0.7152 * linear(c.1) + 0.0722 * linear(c.2)
        };
        for (name, colour) in names.iter().zip(found) {
            // WCAG 2.1, 1.4.3: large or bold text needs a contrast of 3.
            let contrast = 1.05 / (luminance(legible(colour)) + 0.05);
            assert!(contrast > 3.0, "{name}: {contrast}");
        }
    }
}
