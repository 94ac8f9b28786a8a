//! Planes in half of their memory, for as long as they only wait.

use half::{f16, slice::HalfFloatSliceExt};
use rayon::prelude::*;

use crate::{
    kernels::memory::{HalfBuffer, half_buffer},
    planes::{Planes, Values},
};

/// [`Planes`] as 16-bit floats and a scale. Values from an EXR file's half floats come back as they were, and
/// others to 11 bits, if they are at least a billionth of the largest.
#[derive(Clone, Debug)]
pub struct HalfFloats {
    channels: usize,
    width: usize,
    height: usize,
    /// What the values were multiplied by: a power of two, so that nothing is lost by it.
    scale: f32,
    data: HalfBuffer,
}

impl HalfFloats {
    /// Of planes whose values are finite.
    pub fn of(planes: &Planes) -> Self {
        let Planes { channels, width, height, data } = planes;
        let row = (*width).max(1);
        let largest = data.par_chunks(row).map(|row| row.iter().fold(0.0, |most: f32, v| most.max(v.abs())));
        let scale = scale(largest.reduce(|| 0.0, f32::max));
        let mut halves = half_buffer(data.len());
        let rows = halves.par_chunks_mut(row).zip(data.par_chunks(row));
        rows.for_each_init(Vec::new, |scaled, (halves, values)| {
            scaled.clear();
            scaled.extend(values.iter().map(|v| v * scale));
            halves.convert_from_f32_slice(scaled);
        });
        Self { channels: *channels, width: *width, height: *height, scale, data: halves }
    }

    /// Of planes that come back as they were; none of others.
    pub fn exactly(planes: &Planes) -> Option<Self> {
        let halves = Self::of(planes);
        let row = planes.width.max(1);
        let is_exact = planes.data.par_chunks(row).enumerate().all(|(i, values)| {
            let mut back = vec![0.0; values.len()];
            halves.read(i / planes.height, i % planes.height * planes.width, &mut back);
            back == values
        });
        is_exact.then_some(halves)
    }

    /// The planes.
    pub fn planes(&self) -> Planes {
        Planes::from_rows(self.channels, (self.width, self.height), |c, y, out| {
            self.read(c, y * self.width, out);
        })
    }
}

impl Values for HalfFloats {
    fn extent(&self) -> (usize, usize, usize) {
        (self.channels, self.width, self.height)
    }

    fn read(&self, channel: usize, first: usize, out: &mut [f32]) {
        let of_channel = &self.data[channel * self.width * self.height..][..self.width * self.height];
        of_channel[first..][..out.len()].convert_to_f32_slice(out);
        out.iter_mut().for_each(|v| *v = (*v / self.scale).clamp(f32::MIN, f32::MAX));
    }
}

/// The largest power of two by which a value is still a half float, as far as an `f32` holds it.
fn scale(largest: f32) -> f32 {
    let of = |exponent: i32| 2.0f32.powi(exponent.min(f32::MAX_EXP - 1));
    let exponent = if largest == 0.0 { 0.0 } else { largest.log2().floor() };
    let highest = f16::MAX_EXP - 1 - exponent as i32;
    if largest * of(highest) > f16::MAX.to_f32() { of(highest - 1) } else { of(highest) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn there_and_back(values: &[f32]) -> Vec<f32> {
        HalfFloats::of(&Planes::from_vec(1, values.len(), 1, values.to_vec())).planes().data.to_vec()
    }

    #[test]
    fn half_floats_come_back_as_they_were() {
        let halves = (0..=u16::MAX).map(|bits| f16::from_bits(bits).to_f32());
        let finite: Vec<f32> = halves.filter(|v| v.is_finite()).collect();
        assert_eq!(there_and_back(&finite), finite);
        let zeros = HalfFloats::of(&Planes::new(2, 3, 1));
        assert_eq!(zeros.planes(), Planes::new(2, 3, 1));
        let exactly = |values: &[f32]| HalfFloats::exactly(&Planes::from_vec(1, 2, 1, values.to_vec()));
        assert!(exactly(&[0.1, 1.0]).is_none() && exactly(&[0.125, 1.0]).is_some());
    }

    #[test]
    fn values_of_any_size_keep_eleven_bits() {
        for exponent in [-100, -40, 0, 40, 127] {
            let values: Vec<f32> = (0..90).map(|i| -(2.0f32.powi(exponent)) * 0.8f32.powi(i)).collect();
            for (value, back) in values.iter().zip(there_and_back(&values)) {
                assert!((value - back).abs() <= value.abs() / 2048.0, "{value} {back}");
            }
        }
        assert_eq!(there_and_back(&[f32::MAX, f32::MIN, 0.0]), [f32::MAX, f32::MIN, 0.0]);
        assert_eq!(there_and_back(&[f32::MIN_POSITIVE, 0.0]), [f32::MIN_POSITIVE, 0.0]);
    }
}
