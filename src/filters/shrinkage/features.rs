//! Features that the [perceptrons](crate::filters::perceptron) read, made of the sums over squares of pixels:
//! logarithms of mean squares and correlations, over three neighbourhoods of each square.

use rayon::prelude::*;

use super::{
    Render,
    sums::{BY_DETAIL, COUNT, CUT, DETAIL, LIGHT, NEXT, NOISE, RESIDUAL, SUMS},
};
use crate::{
    filters::squares,
    kernels::{
        logarithm::ln,
        vectorised::{self, Vectorised},
    },
};

/// Binomial weights of the squares of each neighbourhood.
pub const WINDOWS: [&[f32]; 3] =
    [&[1.0, 2.0, 1.0], &[1.0, 4.0, 6.0, 4.0, 1.0], &[1.0, 8.0, 28.0, 56.0, 70.0, 56.0, 28.0, 8.0, 1.0]];

/// Number of features of each neighbourhood, and of all features. The last three are the brightness of the
/// place, the logarithm to base 2 of the number of samples, and whether that number is known.
const OF_WINDOW: usize = 11;
pub const FEATURES: usize = WINDOWS.len() * OF_WINDOW + 3;
/// The first of those that tell of samples.
pub const SAMPLES: usize = FEATURES - 2;

/// Added to values before their logarithm is taken, and to divisors.
pub const TINY: f32 = 1e-8;

/// Exposed radiance that is added before the brightness's logarithm.
const BLACK: f32 = 0.02;

/// Exposed radiance that brighter places count as: one square in a thousand of generated views is brighter, and nothing
/// was learned of the thousands that lit places come to in a frame that is nearly black elsewhere.
const BRIGHT: f32 = 8.0;

/// What `make` writes for every row of squares, `lines` lines each. It is given the row's number, its
/// features as [`FEATURES`] lines, and where to write.
pub fn each_row(
    sums: &[f32],
    squares: usize,
    lines: usize,
    render: &Render,
    make: impl Fn(usize, &[f32], &mut [f32]) + Sync,
) -> Vec<f32> {
    let sums: Vec<&[f32]> = sums.chunks(SUMS * squares).collect();
    let mut made = vec![0.0; sums.len() * lines * squares];
    let memory = || (vec![0.0; SUMS * squares], vec![0.0; SUMS * squares], vec![0.0; FEATURES * squares]);
    made.par_chunks_mut(lines * squares).enumerate().for_each_init(
        memory,
        |(of_rows, around, features), (row, made)| {
            let (of_windows, of_frame) = features.split_at_mut(WINDOWS.len() * OF_WINDOW * squares);
            for (place, (window, features)) in
                WINDOWS.iter().zip(of_windows.chunks_exact_mut(OF_WINDOW * squares)).enumerate()
            {
                let rows = squares::rows_around(&sums, row, window);
                squares::around(rows, squares, window, of_rows, around);
                vectorised::run(Describe { sums: around, features, squares });
                if place == 0 {
                    let light = around[LIGHT * squares..].iter().zip(&around[COUNT * squares..]);
                    let brightness =
                        |(sum, count): (&f32, &f32)| ln((sum / count * render.exposure).min(BRIGHT) + BLACK);
                    of_frame.iter_mut().zip(light).take(squares).for_each(|(v, of)| *v = brightness(of));
                }
            }
            let samples = render.samples.map_or(0.0, |samples| (samples.max(1) as f32).log2());
            of_frame[squares..2 * squares].fill(samples);
            of_frame[2 * squares..].fill(if render.samples.is_some() { 1.0 } else { 0.0 });
            make(row, features, made);
        },
    );
    made
}

/// The relative variance that the noise of a quarter of the squares stays below, of those that have any.
///
/// Detail of a pixel's size cannot be told from noise where it lies, but it lies in parts of a frame only, while
/// noise is everywhere: the calm quarter has little else.
pub fn noise_of_frame(sums: &[f32], squares: usize) -> f32 {
    let (window, lines) = (WINDOWS[0], (NOISE[1] + 1) * squares);
    let rows: Vec<&[f32]> = sums.chunks(SUMS * squares).map(|row| &row[..lines]).collect();
    let of_row = |row: usize| {
        let (mut of_rows, mut around) = (vec![0.0; lines], vec![0.0; lines]);
        squares::around(squares::rows_around(&rows, row, window), squares, window, &mut of_rows, &mut around);
        let noise = move |s: usize| {
            let [count, light, ratio] = [COUNT, NOISE[0], NOISE[1]].map(|line| around[line * squares + s]);
            light.min(ratio) / count
        };
        (0..squares).map(noise).filter(|noise| *noise > TINY)
    };
    let mut noise: Vec<f32> = (0..rows.len()).flat_map(of_row).collect();
    let quarter = noise.len() / 4;
    if noise.is_empty() { 0.0 } else { *noise.select_nth_unstable_by(quarter, f32::total_cmp).1 }
}

/// Makes features of the sums over a neighbourhood: logarithms of mean squares, and correlations.
struct Describe<'a> {
    sums: &'a [f32],
    /// [`OF_WINDOW`] lines.
    features: &'a mut [f32],
    squares: usize,
}

impl Vectorised for Describe<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { sums, features, squares } = self;
        let line = |line: usize| &sums[line * squares..][..squares];
        // A feature of all squares at a time: the compiler vectorises loops that write one line.
        let per_square = || line(COUNT).iter().map(|count| 1.0 / count);
        let residuals = || line(RESIDUAL).iter().zip(per_square()).map(|(sum, per_pixel)| sum * per_pixel);
        let mut features = features.chunks_exact_mut(squares);
        let mut next = || features.next().expect("a line for each feature");
        for level in [RESIDUAL, NOISE[0], NOISE[1], CUT, DETAIL[0], DETAIL[1]] {
            for ((feature, sum), per_pixel) in next().iter_mut().zip(line(level)).zip(per_square()) {
                *feature = ln((sum * per_pixel).max(0.0) + TINY);
            }
        }
        for share in [NEXT[0], NEXT[1], BY_DETAIL[2]] {
            let sums = line(share).iter().zip(per_square()).zip(residuals());
            for (feature, ((sum, per_pixel), residual)) in next().iter_mut().zip(sums) {
                *feature = sum * per_pixel / (residual + TINY);
            }
        }
        for (alike, with) in [(BY_DETAIL[0], DETAIL[0]), (BY_DETAIL[1], DETAIL[1])] {
            let sums = line(alike).iter().zip(line(with)).zip(per_square()).zip(residuals());
            for (feature, (((sum, with), per_pixel), residual)) in next().iter_mut().zip(sums) {
                let square = with * per_pixel * residual + TINY * TINY;
                *feature = sum * per_pixel / square.max(f32::MIN_POSITIVE).sqrt();
            }
        }
    }
}
