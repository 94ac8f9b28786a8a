//! What depends on the processor: matrix products and conversions. Each kind of processor has a file here,
//! which says behind one trait what instructions it has, what it prefers, and how it multiplies. [`Engine`]
//! is the one that was found.

#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
mod amx;
#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod portable;

use std::{fmt, sync::OnceLock};

use half::bf16;

use super::{Block, Format, Sums, Term, Wide};
use crate::kernels::{
    conv::Geometry,
    simd::choose,
    winograd::{PATCH, SIDE},
};
use portable::{Backend, Portable};

/// Cells side by side that are transformed, multiplied and transformed back together ([`super::winograd`]):
/// what they need meanwhile stays in the second-level cache.
pub const CELLS: usize = 16;

/// The inverse of 9 modulo 2^32.
const NINTH: u32 = 0x38e3_8e39;

/// A product of matrices: 32 positions of an input and the weights of one or two output planes.
#[derive(Clone, Copy)]
pub struct Product<'a> {
    pub terms: &'a [Term],
    /// How many groups of rows of each term's weights are not zero: an engine may leave out the others.
    // Plain loops leave none out, and processors other than x86-64 have only plain loops: there nothing reads
    // this.
    #[cfg_attr(not(target_arch = "x86_64"), expect(dead_code))]
    pub groups: &'a [u8],
    pub position: usize,
    pub weights: *const Wide,
    /// Output planes, 1 or 2, and how many rows their weights lie apart.
    pub outputs: usize,
    pub plane: usize,
}

/// A product, summed over pixels, of 32 input channels, each a row of `stride` bytes, with one or two output
/// planes.
#[derive(Clone, Copy)]
pub struct Correlation {
    /// Number of positions that are summed over, divided by 32.
    pub steps: usize,
    pub channels: *const bf16,
    pub stride: usize,
    /// Positions interleaved two by two.
    pub pairs: *const Wide,
    /// Output planes, 1 or 2, and how many rows they lie apart.
    pub outputs: usize,
    pub plane: usize,
}

/// A way to multiply narrow matrices that this processor has.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Engine(Unit);

#[derive(Clone, Copy, PartialEq, Eq)]
enum Unit {
    Portable(Portable),
    #[cfg(target_arch = "x86_64")]
    Avx2(avx2::Avx2),
    #[cfg(target_arch = "x86_64")]
    AvxVnni(avx2::AvxVnni),
    #[cfg(target_arch = "x86_64")]
    Vnni(avx512::Vnni),
    #[cfg(target_arch = "x86_64")]
    Avx512(avx512::Avx512),
    #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
    Amx(amx::Amx),
}

/// Evaluates `work` with the backend of an engine. Only this macro tells the engines apart.
macro_rules! with_backend {
    ($engine:expr, $backend:ident => $work:expr) => {
        match $engine.0 {
            Unit::Portable($backend) => $work,
            #[cfg(target_arch = "x86_64")]
            Unit::Avx2($backend) => $work,
            #[cfg(target_arch = "x86_64")]
            Unit::AvxVnni($backend) => $work,
            #[cfg(target_arch = "x86_64")]
            Unit::Vnni($backend) => $work,
            #[cfg(target_arch = "x86_64")]
            Unit::Avx512($backend) => $work,
            #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
            Unit::Amx($backend) => $work,
        }
    };
}

impl fmt::Debug for Engine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(with_backend!(self, backend => name(backend)))
    }
}

fn name<B: Backend>(_: B) -> &'static str {
    B::NAME
}

impl Engine {
    /// The reference implementation, on any processor.
    pub const PORTABLE: Engine = Engine(Unit::Portable(Portable));

    /// Every engine this processor can run, slowest first.
    pub fn available() -> Vec<Engine> {
        let units = [
            Backend::detect().map(Unit::Portable),
            #[cfg(target_arch = "x86_64")]
            Backend::detect().map(Unit::Avx2),
            #[cfg(target_arch = "x86_64")]
            Backend::detect().map(Unit::AvxVnni),
            #[cfg(target_arch = "x86_64")]
            Backend::detect().map(Unit::Vnni),
            #[cfg(target_arch = "x86_64")]
            Backend::detect().map(Unit::Avx512),
            #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
            Backend::detect().map(Unit::Amx),
        ];
        units.into_iter().flatten().map(Engine).collect()
    }

    /// The fastest engine, found once. The environment variable `DEMC_ENGINE` (`portable`, `avx2`, `avxvnni`,
    /// `vnni`, `avx512`, `amx`) chooses a slower one, to compare them.
    ///
    /// # Panics
    /// If the variable names none that this processor has.
    pub fn detect() -> Engine {
        static CHOICE: OnceLock<Engine> = OnceLock::new();
        *CHOICE.get_or_init(|| {
            let wanted = std::env::var("DEMC_ENGINE").unwrap_or_default();
            choose("DEMC_ENGINE", &wanted, &Engine::available())
        })
    }

    /// Whether its products of bfloat16 are faster than those of f32.
    pub fn prefers_bf16(self) -> bool {
        with_backend!(self, backend => backend.prefers_bf16())
    }

    /// Whether its products of 8 bits are faster than all others.
    pub fn prefers_int8(self) -> bool {
        with_backend!(self, backend => backend.prefers_int8())
    }

    /// Whether it computes convolutions of this geometry in 8 bits by cells of outputs ([`super::winograd`])
    /// rather than tap by tap.
    pub(super) fn prefers_winograd(self, geometry: Geometry) -> bool {
        with_backend!(self, backend => backend.prefers_winograd(geometry))
    }

    /// Whether, in a convolution of this geometry in 8 bits, it adds up the products of four channels in 16
    /// bits before it adds those sums up in 32.
    pub fn adds_in_16_bits(self, geometry: Geometry) -> bool {
        with_backend!(self, backend => backend.adds_in_16_bits(geometry))
    }

    /// Makes the processor ready for products on this thread while `work` runs.
    pub(super) fn ready<R>(self, work: impl FnOnce() -> R) -> R {
        with_backend!(self, backend => backend.ready(work))
    }

    /// `sums[o][p] = sum over terms of term.input[position + p] * weights[o][term.weights]`, both factors in
    /// `format`.
    ///
    /// # Safety
    /// Called inside [`Engine::ready`]; every term's 32 rows of input and 16 rows of weights can be read.
    pub(super) unsafe fn multiply(self, format: Format, product: Product, sums: &mut Sums) {
        // SAFETY: the caller's promise.
        unsafe {
            with_backend!(self, backend => match format {
                Format::Int8(_) => backend.multiply_int8(product, sums),
                Format::Bf16 => backend.multiply_bf16(product, sums),
            });
        }
    }

    /// Evaluates the patches of `cells` cells side by side, 16 channels of 8 bits, at the 36 points of
    /// [`super::winograd`]. `patch` is where each row of the first patch begins, and `points` where the first
    /// point of the first cell goes. The cells of a point follow one another, a [`Wide`] each, and points lie
    /// `stride` such values apart.
    ///
    /// # Safety
    /// All of them can be read and written.
    pub(super) unsafe fn evaluate(
        self,
        patch: [*const u8; PATCH],
        cells: usize,
        points: *mut u8,
        stride: usize,
    ) {
        // SAFETY: the caller's promise.
        unsafe { with_backend!(self, backend => backend.evaluate(patch, cells, points, stride)) }
    }

    /// `products[o][cell] = sum over parts of points[part][cell] * weights[o][part]` at one point, for
    /// `outputs` (1 or 2) output planes whose weights lie `plane` rows apart. `groups` tell how many groups
    /// of rows each part needs; the other weights are zero.
    ///
    /// # Safety
    /// Parts, and output planes' products, lie [`CELLS`] values apart, and all of them can be read and
    /// written.
    pub(super) unsafe fn multiply_points(
        self,
        groups: &[u8],
        points: *const Wide,
        weights: *const Wide,
        (outputs, plane): (usize, usize),
        cells: usize,
        products: *mut Wide,
    ) {
        // SAFETY: the caller's promise.
        unsafe {
            for o in 0..outputs {
                let (weights, products) = (weights.add(o * plane), products.add(o * CELLS));
                with_backend!(self, backend => {
                    backend.multiply_points(groups, points, weights, cells, products);
                });
            }
        }
    }

    /// Computes the sums of a cell for one output plane from its products at the points, which lie `stride`
    /// values apart. Row `y` of the cell goes to `sums[y]`; `place` is the output plane and the column it
    /// begins at.
    ///
    /// # Safety
    /// All of them can be read.
    pub(super) unsafe fn interpolate(
        self,
        products: *const Wide,
        stride: usize,
        sums: &mut [Sums; SIDE],
        place: (usize, usize),
    ) {
        // SAFETY: the caller's promise.
        unsafe { with_backend!(self, backend => backend.interpolate(products, stride, sums, place)) }
    }

    /// `sums[o][half][i] += sum over positions of channels[16 half + i][position] * pairs[o][position]`.
    ///
    /// # Safety
    /// Called inside [`Engine::ready`]; all rows can be read.
    pub(super) unsafe fn correlate(self, correlation: Correlation, sums: &mut Sums) {
        // SAFETY: the caller's promise.
        unsafe { with_backend!(self, backend => backend.correlate(correlation, sums)) }
    }

    /// Rounds 32 channels, the upper 16 of which may be absent, to bfloat16, block by block.
    pub(super) fn narrow(self, low: &[Block], high: Option<&[Block]>, out: &mut [Wide]) {
        assert!(low.len() <= out.len());
        // SAFETY: as many values are written as there are blocks.
        unsafe { self.narrow_spread(low, high, out.as_mut_ptr(), 1) }
    }

    /// [`Engine::narrow`], writing every `step`th value from `out` on.
    ///
    /// # Safety
    /// `out` is valid for as many writes.
    pub(super) unsafe fn narrow_spread(
        self,
        low: &[Block],
        high: Option<&[Block]>,
        out: *mut Wide,
        step: usize,
    ) {
        assert!(high.is_none_or(|high| high.len() == low.len()));
        // SAFETY: the caller's promise.
        unsafe { with_backend!(self, backend => backend.narrow_spread(low, high, out, step)) }
    }

    /// Rounds pairs of blocks to bfloat16 and interleaves them: channel `c` of block `2i + j` becomes value
    /// `2c + j` of `out[i]`.
    pub(super) fn interleave(self, pairs: &[[Block; 2]], out: &mut [Wide]) {
        with_backend!(self, backend => backend.interleave(pairs, out));
    }

    /// Rounds up to 16 blocks to bfloat16 and lays each of their 16 channels out as a row: channel `c` of
    /// block `i` becomes `rows[c * stride + i]`. All 16 places of a row are written.
    ///
    /// # Safety
    /// `rows` is valid for writes of 16 values in each of 16 rows of `stride` values.
    pub(super) unsafe fn transpose(self, blocks: &[Block], rows: *mut bf16, stride: usize) {
        // SAFETY: the caller's promise.
        unsafe { with_backend!(self, backend => backend.transpose(blocks, rows, stride)) }
    }
}

/// What the processor tells of itself by the CPUID instruction.
#[cfg(target_arch = "x86_64")]
#[allow(unused_unsafe)] // Newer versions of Rust hold the intrinsic to be safe.
fn cpuid(leaf: u32) -> std::arch::x86_64::CpuidResult {
    // SAFETY: every processor of this architecture has the instruction.
    unsafe { std::arch::x86_64::__cpuid_count(leaf, 0) }
}
