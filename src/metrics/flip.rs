//! HDR-FLIP: how visible a difference is when one flips between two renders, 0 to 1, lower is better.
//!
//! Andersson, Nilsson, Akenine-Moller, Oskarsson, Astrom, Fairchild, "FLIP: A Difference Evaluator for
//! Alternating Images" (2020), and Andersson, Nilsson, Shirley, Akenine-Moller, "Visualizing Errors in
//! Rendered High Dynamic Range Images" (2021): the maximum of FLIP over exposures that span the
//! reference, tone mapped, averaged over pixels. Radiance below zero counts as black, where the authors' program lets
//! the tone mapping make of it what it does.

use rayon::prelude::*;

use crate::{kernels::thirds, planes::Planes};

/// Pixels per degree of visual angle: a 0.7 m wide monitor of 3840 pixels seen from 0.7 m.
const PIXELS_PER_DEGREE: f32 = 67.020_64;
/// Exponent of the colour difference.
const QC: f32 = 0.7;
/// Colour differences below this share of the largest one are spread over the share [`PT`] of the output
/// range.
const PC: f32 = 0.4;
/// Share of the output range for colour differences below the share [`PC`] of the largest one.
const PT: f32 = 0.95;
/// Exponent of the feature difference.
const QF: f32 = 0.5;
/// Width of the feature detectors in degrees.
const FEATURE_WIDTH: f32 = 0.082;
/// Contrast sensitivity of the achromatic, red-green and blue-yellow channels:
/// amplitudes and widths of up to two Gaussians.
const CSF: [&[(f32, f32)]; 3] = [&[(1.0, 0.0047)], &[(1.0, 0.0053)], &[(34.1, 0.04), (13.5, 0.025)]];
/// Tone mapped brightness to which the darkest exposure brings the reference's maximum, and the brightest
/// exposure its median (2021).
const TONE_TARGET: f32 = 0.85;
/// Narkowicz' fit of the ACES curve with the 2021 paper's factor of 0.6 on radiance:
/// `(k0 x^2 + k1 x) / (k2 x^2 + k3 x + k4)`.
const ACES: [f32; 5] = [0.36 * 2.51, 0.6 * 0.03, 0.36 * 2.43, 0.6 * 0.59, 0.14];
/// Linear sRGB to XYZ, from the primaries and the D65 white point (0.3127, 0.3290).
const RGB_TO_XYZ: [[f32; 3]; 3] = [
    [0.412_386_56, 0.357_591_5, 0.180_450_49],
    [0.212_636_82, 0.715_183, 0.072_180_2],
    [0.019_330_62, 0.119_197_16, 0.950_372_6],
];
/// The inverse of [`RGB_TO_XYZ`].
const XYZ_TO_RGB: [[f32; 3]; 3] = [
    [3.241_003_3, -1.537_399, -0.498_615_9],
    [-0.969_224_3, 1.875_93, 0.041_554_226],
    [0.055_639_423, -0.204_011_2, 1.057_149],
];

/// Mean HDR-FLIP of two radiance images; none where the reference has no positive luminance.
pub fn hdr_flip(image: &Planes, reference: &Planes) -> Option<f64> {
    let map = hdr_flip_map(image, reference)?;
    Some(map.iter().map(|&v| f64::from(v)).sum::<f64>() / map.len() as f64)
}

/// HDR-FLIP of every pixel, row-major.
///
/// # Panics
/// If the images are not (3, H, W) of one size.
pub fn hdr_flip_map(image: &Planes, reference: &Planes) -> Option<Vec<f32>> {
    assert!(image.extent() == (3, reference.width, reference.height), "FLIP compares RGB images of one size");
    let filters = Filters::new();
    let mut worst = vec![0.0f32; reference.pixels()];
    for exposure in exposures(reference)? {
        let [t, r] = [image, reference].map(|p| filters.perceive(&tone_map(p, exposure)));
        let flip = difference(&t, &r);
        worst.par_iter_mut().zip(flip).for_each(|(w, f)| *w = w.max(f));
    }
    Some(worst)
}

/// The exposures, which are factors on radiance, darkest first (2021). The first brings the reference's
/// brightest pixel to 0.85 after tone mapping, and the last its median. They are evenly spaced in stops.
/// There are as many as there are stops between the first and the last, rounded up, and at least two.
fn exposures(reference: &Planes) -> Option<Vec<f32>> {
    let [r, g, b] = [0, 1, 2].map(|c| reference.channel(c));
    let y = RGB_TO_XYZ[1];
    let mut luminance: Vec<f32> =
        (0..reference.pixels()).map(|i| y[0] * r[i] + y[1] * g[i] + y[2] * b[i]).collect();
    luminance.par_sort_unstable_by(f32::total_cmp);
    let brightest = *luminance.last()?;
    if brightest <= 0.0 {
        return None;
    }
    let middle = luminance.len() / 2;
    let median = match luminance.len() % 2 {
        0 => (luminance[middle - 1] + luminance[middle]) / 2.0,
        _ => luminance[middle],
    };
    // A median of zero (mostly black background) would ask for an infinite exposure.
    let median = median.max(f32::EPSILON).min(brightest);
    // tone(x) = 0.85 solved for x: the positive root of a x^2 + b x + c.
    let [k0, k1, k2, k3, k4] = ACES;
    let (a, b, c) = (k0 - TONE_TARGET * k2, k1 - TONE_TARGET * k3, -TONE_TARGET * k4);
    let x = (-b + (b * b - 4.0 * a * c).sqrt()) / (2.0 * a);
    let (start, stop) = ((x / brightest).log2(), (x / median).log2());
    let count = (stop - start).ceil().max(2.0) as usize;
    Some((0..count).map(|i| (start + i as f32 * (stop - start) / (count - 1) as f32).exp2()).collect())
}

/// Exposed, tone mapped linear RGB in 0..1.
fn tone_map(radiance: &Planes, exposure: f32) -> Planes {
    let [k0, k1, k2, k3, k4] = ACES;
    let mut image = radiance.clone();
    image.data.par_iter_mut().for_each(|v| {
        let x = (*v * exposure).max(0.0);
        // Above this the curve is 1 and x^2 might overflow.
        *v = if x > 1e6 { 1.0 } else { ((k0 * x * x + k1 * x) / (k2 * x * x + k3 * x + k4)).clamp(0.0, 1.0) };
    });
    image
}

/// What the eye makes of an image: contrast-filtered, Hunt-adjusted CIELab and feature strengths.
struct Percept {
    /// (3, H, W).
    lab: Planes,
    /// Magnitude of edges, then of points: (2, H, W).
    features: Planes,
}

/// A one-dimensional kernel of odd length.
type Kernel = Vec<f32>;

/// The separable kernels of the colour pipeline and of the feature pipeline.
struct Filters {
    /// Per opponent channel: weight and Gaussian.
    csf: [Vec<(f32, Kernel)>; 3],
    gaussian: Kernel,
    edge: Kernel,
    point: Kernel,
}

impl Filters {
    fn new() -> Self {
        let pi = std::f32::consts::PI;
        // All channels share the radius of the widest Gaussian: three standard deviations.
        let widest = CSF.iter().flat_map(|g| g.iter()).map(|g| g.1).fold(0.0, f32::max);
        let radius = (3.0 * (widest / (2.0 * pi * pi)).sqrt() * PIXELS_PER_DEGREE).ceil() as i32;
        let csf = CSF.map(|gaussians| {
            let raw: Vec<(f32, Kernel)> = gaussians
                .iter()
                .map(|&(a, b)| {
                    let value = |i: i32| (-pi * pi * (i as f32 / PIXELS_PER_DEGREE).powi(2) / b).exp();
                    let kernel: Kernel = (-radius..=radius).map(value).collect();
                    let sum: f32 = kernel.iter().sum();
                    // The kernel is normalised; the weight keeps its share of the two-dimensional sum.
                    (a * (pi / b).sqrt() * sum * sum, kernel.iter().map(|v| v / sum).collect())
                })
                .collect();
            let total: f32 = raw.iter().map(|(w, _)| w).sum();
            raw.into_iter().map(|(w, k)| (w / total, k)).collect()
        });
        let sigma = 0.5 * FEATURE_WIDTH * PIXELS_PER_DEGREE;
        let radius = (3.0 * sigma).ceil() as i32;
        let kernel = |f: &dyn Fn(f32) -> f32| -> Kernel {
            let gaussian = |x: f32| (-x * x / (2.0 * sigma * sigma)).exp();
            let raw: Kernel = (-radius..=radius).map(|i| f(i as f32) * gaussian(i as f32)).collect();
            // Positive weights add up to 1 and negative ones to -1.
            let positive: f32 = raw.iter().filter(|v| **v > 0.0).sum();
            let negative: f32 = -raw.iter().filter(|v| **v < 0.0).sum::<f32>();
            raw.iter().map(|v| if *v > 0.0 { v / positive } else { v / negative.max(1e-30) }).collect()
        };
        Self {
            csf,
            gaussian: kernel(&|_| 1.0),
            edge: kernel(&|x| -x),
            point: kernel(&|x| x * x / (sigma * sigma) - 1.0),
        }
    }

    /// Runs the colour and the feature pipeline over linear RGB in 0..1.
    fn perceive(&self, rgb: &Planes) -> Percept {
        let (width, height) = (rgb.width, rgb.height);
        let opponent = map_pixels(rgb, |rgb| opponent(multiply(&RGB_TO_XYZ, rgb)));
        let mut filtered = Planes::new(3, width, height);
        for (c, gaussians) in self.csf.iter().enumerate() {
            for (weight, kernel) in gaussians {
                let blurred = columns(&rows(opponent.channel(c), width, kernel), width, kernel);
                filtered.channel_mut(c).iter_mut().zip(blurred).for_each(|(f, b)| *f += weight * b);
            }
        }
        let lab = map_pixels(&filtered, |ycc| {
            let rgb = multiply(&XYZ_TO_RGB, from_opponent(ycc)).map(|v| v.clamp(0.0, 1.0));
            hunt(lab(multiply(&RGB_TO_XYZ, rgb)))
        });
        // Features are found in the unfiltered achromatic channel, scaled to 0..1.
        let grey: Vec<f32> = opponent.channel(0).iter().map(|y| (y + 16.0) / 116.0).collect();
        let smooth = rows(&grey, width, &self.gaussian);
        let mut features = Planes::new(2, width, height);
        for (c, derivative) in [&self.edge, &self.point].into_iter().enumerate() {
            let dx = columns(&rows(&grey, width, derivative), width, &self.gaussian);
            let dy = columns(&smooth, width, derivative);
            let magnitudes = dx.iter().zip(&dy).map(|(x, y)| x.hypot(*y));
            features.channel_mut(c).iter_mut().zip(magnitudes).for_each(|(f, m)| *f = m);
        }
        Percept { lab, features }
    }
}

/// FLIP of every pixel: the colour difference raised to one minus the feature difference.
fn difference(test: &Percept, reference: &Percept) -> Vec<f32> {
    let extreme = |rgb| hunt(lab(multiply(&RGB_TO_XYZ, rgb)));
    // The largest difference within sRGB is between green and blue.
    let largest = hyab(extreme([0.0, 1.0, 0.0]), extreme([0.0, 0.0, 1.0])).powf(QC);
    let knee = PC * largest;
    let n = test.lab.pixels();
    let at = |p: &Planes, i: usize| [p.data[i], p.data[n + i], p.data[2 * n + i]];
    (0..n)
        .into_par_iter()
        .map(|i| {
            let error = hyab(at(&test.lab, i), at(&reference.lab, i)).powf(QC);
            let colour = if error < knee {
                PT / knee * error
            } else {
                PT + (error - knee) / (largest - knee) * (1.0 - PT)
            };
            let strength = |c: usize| (test.features.channel(c)[i] - reference.features.channel(c)[i]).abs();
            let feature = (strength(0).max(strength(1)) / 2.0f32.sqrt()).powf(QF);
            colour.powf(1.0 - feature)
        })
        .collect()
}

fn multiply(matrix: &[[f32; 3]; 3], v: [f32; 3]) -> [f32; 3] {
    matrix.map(|row| row[0] * v[0] + row[1] * v[1] + row[2] * v[2])
}

/// XYZ of the white point: linear RGB (1, 1, 1).
fn white() -> [f32; 3] {
    RGB_TO_XYZ.map(|row| row.iter().sum())
}

/// XYZ to the linearised opponent space YCxCz.
fn opponent(xyz: [f32; 3]) -> [f32; 3] {
    let w = white();
    let [x, y, z] = [xyz[0] / w[0], xyz[1] / w[1], xyz[2] / w[2]];
    [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
}

/// The inverse of [`opponent`].
fn from_opponent(ycc: [f32; 3]) -> [f32; 3] {
    let w = white();
    let y = (ycc[0] + 16.0) / 116.0;
    [w[0] * (ycc[1] / 500.0 + y), w[1] * y, w[2] * (y - ycc[2] / 200.0)]
}

/// XYZ to CIELab.
fn lab(xyz: [f32; 3]) -> [f32; 3] {
    const DELTA: f32 = 6.0 / 29.0;
    let w = white();
    let f = |t: f32| if t > DELTA.powi(3) { t.cbrt() } else { t / (3.0 * DELTA * DELTA) + 4.0 / 29.0 };
    let [x, y, z] = [f(xyz[0] / w[0]), f(xyz[1] / w[1]), f(xyz[2] / w[2])];
    [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
}

/// The Hunt effect: colours of dark pixels differ less.
fn hunt([l, a, b]: [f32; 3]) -> [f32; 3] {
    [l, 0.01 * l * a, 0.01 * l * b]
}

/// City-block in lightness, Euclidean in chroma (HyAB).
fn hyab(a: [f32; 3], b: [f32; 3]) -> f32 {
    (a[0] - b[0]).abs() + (a[1] - b[1]).hypot(a[2] - b[2])
}

/// Applies `f` to every pixel of a (3, H, W) image.
fn map_pixels(image: &Planes, f: impl Fn([f32; 3]) -> [f32; 3] + Sync) -> Planes {
    let mut out = Planes::new(3, image.width, image.height);
    let n = image.pixels();
    let [first, second, third] = thirds(&mut out.data);
    let planes = first.par_iter_mut().zip(second).zip(third).enumerate();
    planes.for_each(|(i, ((a, b), c))| {
        [*a, *b, *c] = f([image.data[i], image.data[n + i], image.data[2 * n + i]]);
    });
    out
}

/// Convolves every row; beyond its ends a row goes on with its end values.
fn rows(plane: &[f32], width: usize, kernel: &Kernel) -> Vec<f32> {
    let radius = kernel.len() / 2;
    let mut out = vec![0.0; plane.len()];
    out.par_chunks_mut(width).zip(plane.par_chunks(width)).for_each_init(
        || vec![0.0; width + 2 * radius],
        |padded, (out, row)| {
            padded[..radius].fill(row[0]);
            padded[radius..radius + width].copy_from_slice(row);
            padded[radius + width..].fill(row[width - 1]);
            for (offset, &weight) in kernel.iter().rev().enumerate() {
                out.iter_mut().zip(&padded[offset..]).for_each(|(o, v)| *o += weight * v);
            }
        },
    );
    out
}

/// Convolves every column; beyond its ends a column goes on with its end values.
fn columns(plane: &[f32], width: usize, kernel: &Kernel) -> Vec<f32> {
    let (radius, height) = (kernel.len() as isize / 2, plane.len() / width);
    let mut out = vec![0.0; plane.len()];
    out.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
        for (offset, &weight) in kernel.iter().rev().enumerate() {
            let from = (y as isize + offset as isize - radius).clamp(0, height as isize - 1) as usize;
            let row = &plane[from * width..][..width];
            out.iter_mut().zip(row).for_each(|(o, v)| *o += weight * v);
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn matrices_are_inverses_and_white_is_neutral() {
        for i in 0..3 {
            let mut unit = [0.0; 3];
            unit[i] = 1.0;
            let back = multiply(&XYZ_TO_RGB, multiply(&RGB_TO_XYZ, unit));
            for (found, expected) in back.iter().zip(unit) {
                assert!((found - expected).abs() < 2e-6, "{back:?}");
            }
        }
        let white = lab(white());
        assert!((white[0] - 100.0).abs() < 1e-4 && white[1].abs() < 1e-4 && white[2].abs() < 1e-4);
    }

    #[test]
    fn equal_images_differ_by_nothing_and_black_has_no_exposure() {
        let image = Planes::from_vec(3, 5, 4, (0..60).map(|i| i as f32).collect());
        assert_eq!(hdr_flip(&image, &image), Some(0.0));
        assert_eq!(hdr_flip(&image, &Planes::new(3, 5, 4)), None);
    }

    #[test]
    fn stays_within_its_range_and_grows_with_the_error() {
        let reference = Planes::from_vec(3, 32, 24, vec![0.5; 3 * 32 * 24]);
        let mut previous = 0.0;
        for offset in [0.05f32, 0.2, 1.0, 60000.0] {
            let mut image = reference.clone();
            image.data.iter_mut().for_each(|v| *v += offset);
            let flip = hdr_flip(&image, &reference).unwrap();
            assert!(flip > previous && flip <= 1.0, "{offset}: {flip}");
            previous = flip;
        }
    }

    #[test]
    fn exposures_span_maximum_to_median_in_steps_of_a_stop_at_most() {
        let mut reference = Planes::from_vec(3, 9, 9, vec![1.0; 243]);
        for c in 0..3 {
            reference.channel_mut(c)[0] = 40.0;
        }
        let found = exposures(&reference).unwrap();
        assert_eq!(found.len(), 6, "log2(40) = 5.3 stops");
        assert!((found[5] / found[0] - 40.0).abs() < 1e-3);
        let tone = tone_map(&reference, found[5]);
        assert!((tone.channel(0)[1] - TONE_TARGET).abs() < 1e-4, "the median meets the target");
    }
}
