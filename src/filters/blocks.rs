//! Statistics over the square block around each pixel, as much of it as lies inside the image.

use rayon::prelude::*;

use crate::planes::Planes;

/// Mean and variance of the block of `radius` around each pixel, channel by channel.
pub fn moments(image: &Planes, radius: usize) -> (Planes, Planes) {
    let mean = block_mean(image, radius);
    let mut squares = image.clone();
    squares.data.iter_mut().for_each(|v| *v *= *v);
    let mut variance = block_mean(&squares, radius);
    variance.data.iter_mut().zip(&mean.data).for_each(|(v, m)| *v = (*v - m * m).max(0.0));
    (mean, variance)
}

/// The mean of the block around each pixel: rows first, then columns.
fn block_mean(image: &Planes, radius: usize) -> Planes {
    let (w, h) = (image.width, image.height);
    let span = |at: usize, end: usize| (at.saturating_sub(radius), (at + radius + 1).min(end));
    let mut rows = image.clone();
    rows.data.par_chunks_mut(w).zip(image.data.par_chunks(w)).for_each(|(out, row)| {
        for (x, v) in out.iter_mut().enumerate() {
            let (x0, x1) = span(x, w);
            *v = row[x0..x1].iter().sum::<f32>() / (x1 - x0) as f32;
        }
    });
    let mut out = Planes::new(image.channels, w, h);
    out.data.par_chunks_mut(w).enumerate().for_each(|(i, out)| {
        let (plane, y) = (i / h * h, i % h);
        let (y0, y1) = span(y, h);
        for row in plane + y0..plane + y1 {
            out.iter_mut().zip(&rows.data[row * w..][..w]).for_each(|(sum, v)| *sum += v);
        }
        out.iter_mut().for_each(|sum| *sum /= (y1 - y0) as f32);
    });
    out
}

/// The median, over the block of `radius` around each pixel, of the distance from the block's median:
/// a deviation that outliers do not move.
pub fn median_deviation(image: &Planes, radius: usize) -> Planes {
    let (w, h) = (image.width, image.height);
    let mut out = Planes::new(image.channels, w, h);
    out.data.par_chunks_mut(w).enumerate().for_each_init(Vec::new, |block, (i, out)| {
        let (plane, y) = (i / h * h, i % h);
        let rows = plane + y.saturating_sub(radius)..plane + (y + radius + 1).min(h);
        for (x, out) in out.iter_mut().enumerate() {
            let (x0, x1) = (x.saturating_sub(radius), (x + radius + 1).min(w));
            block.clear();
            rows.clone().for_each(|row| block.extend_from_slice(&image.data[row * w + x0..row * w + x1]));
            let centre = median(block);
            block.iter_mut().for_each(|v| *v = (*v - centre).abs());
            *out = median(block);
        }
    });
    out
}

/// The middle value, the upper of two.
fn median(values: &mut [f32]) -> f32 {
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_are_cut_at_the_border() {
        let image = Planes::from_vec(1, 3, 2, vec![1.0, 2.0, 3.0, 4.0, 5.0, 9.0]);
        let (mean, variance) = moments(&image, 1);
        assert_eq!(mean.data, [3.0, 4.0, 4.75, 3.0, 4.0, 4.75]);
        // 1 2 4 5 about 3, and 2 3 5 9 about 4.75.
        assert!((variance.data[0] - 2.5).abs() < 1e-5 && (variance.data[2] - 7.1875).abs() < 1e-5);
        assert_eq!(moments(&image, 9).0.data, [4.0; 6]);
    }

    #[test]
    fn the_median_deviation_by_hand() {
        let image = Planes::from_vec(2, 3, 1, vec![1.0, 2.0, 10.0, 7.0, 7.0, 7.0]);
        // 1 2: upper median 2, distances 1 0; 1 2 10: median 2, distances 1 0 8; 2 10: median 10.
        assert_eq!(median_deviation(&image, 1).data, [1.0, 1.0, 8.0, 0.0, 0.0, 0.0]);
    }
}
