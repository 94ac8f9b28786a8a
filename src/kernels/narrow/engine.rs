//! What depends on the processor: matrix products and conversions.

use std::{fmt, sync::OnceLock};

use half::bf16;

use super::{Block, CHUNK, Format, GROUP, LANES, Sums, Term, WIDE, WORD, Wide, winograd::SQUARES};
use crate::kernels::{
    conv::Geometry,
    simd::choose,
    winograd::{PATCH, SIDE},
};

/// A way to multiply narrow matrices that this processor has.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Engine(Unit);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Unit {
    Portable,
    /// AVX2: four multiply-accumulates of 8 bits a lane, in three instructions. bfloat16 is [`Unit::Portable`]'s, here and up to
    /// AVX512-VNNI.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// AVX-VNNI: as many in one.
    #[cfg(target_arch = "x86_64")]
    AvxVnni,
    /// AVX512-VNNI: four multiply-accumulates of 8 bits a lane, of twice as many.
    #[cfg(target_arch = "x86_64")]
    Vnni,
    /// AVX512-BF16 besides: two multiply-accumulates a lane.
    #[cfg(target_arch = "x86_64")]
    Avx512,
    /// AMX-BF16: 16x16 tiles, 8192 multiply-accumulates an instruction. 8 bits are [`Unit::Vnni`]'s.
    #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
    Amx,
}

impl fmt::Debug for Engine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl Engine {
    /// The reference implementation, on any processor.
    pub const PORTABLE: Engine = Engine(Unit::Portable);

    /// Every engine this processor can run, slowest first.
    pub fn available() -> Vec<Engine> {
        #[allow(unused_mut)]
        let mut engines = vec![Engine::PORTABLE];
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx2") {
                engines.push(Engine(Unit::Avx2));
                if is_x86_feature_detected!("avxvnni") {
                    engines.push(Engine(Unit::AvxVnni));
                }
            }
            if is_x86_feature_detected!("avx512vnni") && is_x86_feature_detected!("avx512bw") {
                engines.push(Engine(Unit::Vnni));
                if is_x86_feature_detected!("avx512bf16") {
                    engines.push(Engine(Unit::Avx512));
                    #[cfg(target_os = "linux")]
                    if amx::permitted() {
                        engines.push(Engine(Unit::Amx));
                    }
                }
            }
        }
        engines
    }

    /// The fastest engine, found once. The environment variable `DEMC_ENGINE` (`portable`, `avx2`, `avxvnni`, `vnni`,
    /// `avx512`, `amx`) chooses a slower one, to compare them.
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

    /// Whether its products of bfloat16 are faster than those of f32. Those of AVX512-BF16 are on AMD's processors; on
    /// Intel's (Emerald Rapids) a training step in bfloat16 takes 1.7 x as long.
    pub fn prefers_bf16(self) -> bool {
        match self.0 {
            #[cfg(target_arch = "x86_64")]
            Unit::Avx512 => !is_intel(),
            #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
            Unit::Amx => true,
            _ => false,
        }
    }

    /// Whether it has instructions for bfloat16.
    fn has_bf16(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        return !matches!(self.0, Unit::Portable | Unit::Avx2 | Unit::AvxVnni | Unit::Vnni);
        #[cfg(not(target_arch = "x86_64"))]
        false
    }

    /// Whether its products of 8 bits are faster than all others.
    pub fn prefers_int8(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        return matches!(self.0, Unit::Avx2 | Unit::AvxVnni | Unit::Vnni | Unit::Avx512);
        #[cfg(not(target_arch = "x86_64"))]
        false
    }

    /// Whether it has convolutions of 8 bits of a geometry by squares of outputs ([`super::winograd`]) rather than tap by tap.
    pub(super) fn prefers_squares(self, geometry: Geometry) -> bool {
        #[cfg(target_arch = "x86_64")]
        return self.0 == Unit::Avx2 && geometry == Geometry::Same(3);
        #[cfg(not(target_arch = "x86_64"))]
        false
    }

    /// Whether it adds up products of 8 bits in 16 before it does in 32, those of four channels, in a convolution of a geometry.
    pub fn adds_in_16_bits(self, geometry: Geometry) -> bool {
        #[cfg(target_arch = "x86_64")]
        return self.0 == Unit::Avx2 && !self.prefers_squares(geometry);
        #[cfg(not(target_arch = "x86_64"))]
        false
    }

    /// Makes the processor ready for products on this thread while `work` runs.
    pub(super) fn ready<R>(self, work: impl FnOnce() -> R) -> R {
        match self.0 {
            #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
            Unit::Amx => {
                let _tiles = amx::Tiles::configure();
                work()
            }
            _ => work(),
        }
    }

    /// `sums[o][p] = sum over terms of term.input[position + p] * weights[o][term.weights]` for 32 positions
    /// and `outputs` (1 or 2) output planes whose weights lie `plane` rows apart, both factors in `format`. The
    /// weights of a term beyond its `groups` of rows are zero: an engine may leave them out.
    ///
    /// # Safety
    /// Called inside [`Engine::ready`]; every term's 32 rows of input and 16 rows of weights can be read.
    pub(super) unsafe fn multiply(
        self,
        format: Format,
        (terms, groups): (&[Term], &[u8]),
        position: usize,
        weights: *const Wide,
        (outputs, plane): (usize, usize),
        sums: &mut Sums,
    ) {
        // SAFETY: an engine is only made after its instructions were detected; the rest is the caller's.
        unsafe {
            match (self.0, format) {
                #[cfg(target_arch = "x86_64")]
                (Unit::Avx2, Format::Int8(_)) => {
                    avx2::multiply((terms, groups), position, weights, (outputs, plane), sums);
                }
                #[cfg(target_arch = "x86_64")]
                (Unit::AvxVnni, Format::Int8(_)) => {
                    avx2::multiply_vnni((terms, groups), position, weights, (outputs, plane), sums);
                }
                #[cfg(target_arch = "x86_64")]
                (Unit::Vnni | Unit::Avx512, Format::Int8(_)) => {
                    avx512::multiply_int8((terms, groups), position, weights, (outputs, plane), sums);
                }
                #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
                (Unit::Amx, Format::Int8(_)) => {
                    avx512::multiply_int8((terms, groups), position, weights, (outputs, plane), sums);
                }
                #[cfg(target_arch = "x86_64")]
                (Unit::Avx512, Format::Bf16) => {
                    avx512::multiply_bf16((terms, groups), position, weights, (outputs, plane), sums);
                }
                #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
                (Unit::Amx, Format::Bf16) => {
                    amx::multiply(terms, position, weights, (outputs, plane), sums);
                }
                _ => portable::multiply(format, terms, position, weights, (outputs, plane), sums),
            }
        }
    }

    /// 16 channels of 8 bits of the patches of `squares` squares side by side, at the 36 points of [`super::winograd`]: `patch` is where
    /// each row of the first begins, `points` where the first point of the first square goes. Squares follow one another, and points lie `stride`
    /// squares apart, a [`Wide`] each.
    ///
    /// # Safety
    /// All of them can be read and written.
    pub(super) unsafe fn evaluate(
        self,
        patch: [*const u8; PATCH],
        squares: usize,
        points: *mut u8,
        stride: usize,
    ) {
        // SAFETY: the caller's promise; an engine is only made after its instructions were detected.
        unsafe {
            #[cfg(target_arch = "x86_64")]
            if self.0 != Unit::Portable {
                return avx2::evaluate(patch, squares, points, stride);
            }
            portable::evaluate(patch, squares, points, stride);
        }
    }

    /// `products[o][square] = sum over parts of points[part][square] * weights[o][part]` at one point, for `outputs` (1 or 2) output
    /// planes whose weights lie `plane` rows apart. `groups` tell how many groups of rows each part needs; the other
    /// weights are zero.
    ///
    /// # Safety
    /// Parts, and output planes' products, lie [`SQUARES`] values apart, and all of them can be read and written.
    pub(super) unsafe fn multiply_points(
        self,
        groups: &[u8],
        points: *const Wide,
        weights: *const Wide,
        (outputs, plane): (usize, usize),
        squares: usize,
        products: *mut Wide,
    ) {
        // SAFETY: as in `evaluate`.
        unsafe {
            for o in 0..outputs {
                let (weights, products) = (weights.add(o * plane), products.add(o * SQUARES));
                #[cfg(target_arch = "x86_64")]
                if self.0 != Unit::Portable {
                    avx2::multiply_points(groups, points, weights, squares, products);
                    continue;
                }
                portable::multiply_points(groups, points, weights, squares, products);
            }
        }
    }

    /// The sums of a square for one output plane, from its products at the points, which lie `stride` values apart: row `y` of the
    /// square goes to `sums[y]`, from `column` on.
    ///
    /// # Safety
    /// All of them can be read.
    pub(super) unsafe fn interpolate(
        self,
        products: *const Wide,
        stride: usize,
        sums: &mut [Sums; SIDE],
        (output, column): (usize, usize),
    ) {
        // SAFETY: as in `evaluate`.
        unsafe {
            #[cfg(target_arch = "x86_64")]
            if self.0 != Unit::Portable {
                return avx2::interpolate(products, stride, sums, (output, column));
            }
            portable::interpolate(products, stride, sums, (output, column));
        }
    }

    /// `sums[o][half][i] += sum over positions of channels[16 half + i][position] * pairs[o][position]`:
    /// 32 input channels, each a row of `stride` bytes, against `outputs` (1 or 2) output planes, `plane`
    /// rows apart, of `steps` times 32 positions interleaved two by two.
    ///
    /// # Safety
    /// Called inside [`Engine::ready`]; all rows can be read.
    pub(super) unsafe fn correlate(
        self,
        steps: usize,
        channels: *const bf16,
        stride: usize,
        pairs: *const Wide,
        (outputs, plane): (usize, usize),
        sums: &mut Sums,
    ) {
        // SAFETY: as in `multiply`.
        unsafe {
            match self.0 {
                #[cfg(target_arch = "x86_64")]
                Unit::Avx512 => avx512::correlate(steps, channels, stride, pairs, (outputs, plane), sums),
                #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
                Unit::Amx => amx::correlate(steps, channels, stride, pairs, (outputs, plane), sums),
                _ => portable::correlate(steps, channels, stride, pairs, (outputs, plane), sums),
            }
        }
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
        // SAFETY: the caller's promise; an engine is only made after its instructions were detected.
        unsafe {
            match self.0 {
                #[cfg(target_arch = "x86_64")]
                _ if self.has_bf16() => avx512::narrow_spread(low, high, out, step),
                _ => portable::narrow_spread(low, high, out, step),
            }
        }
    }

    /// Rounds pairs of blocks to bfloat16 and interleaves them: channel `c` of block `2i + j` becomes value
    /// `2c + j` of `out[i]`.
    pub(super) fn interleave(self, pairs: &[[Block; 2]], out: &mut [Wide]) {
        match self.0 {
            // SAFETY: an engine is only made after its instructions were detected.
            #[cfg(target_arch = "x86_64")]
            _ if self.has_bf16() => unsafe { avx512::interleave(pairs, out) },
            _ => portable::interleave(pairs, out),
        }
    }

    /// Rounds up to 16 blocks to bfloat16 and lays each of their 16 channels out as a row: channel `c` of
    /// block `i` becomes `rows[c * stride + i]`. All 16 places of a row are written.
    ///
    /// # Safety
    /// `rows` is valid for writes of 16 values in each of 16 rows of `stride` values.
    pub(super) unsafe fn transpose(self, blocks: &[Block], rows: *mut bf16, stride: usize) {
        // SAFETY: the caller's promise; instructions as above.
        unsafe {
            match self.0 {
                #[cfg(target_arch = "x86_64")]
                _ if self.has_bf16() => avx512::transpose(blocks, rows, stride),
                _ => portable::transpose(blocks, rows, stride),
            }
        }
    }
}

/// What the processor says of itself.
#[cfg(target_arch = "x86_64")]
#[allow(unused_unsafe)] // Newer versions of Rust hold the intrinsic to be safe.
fn cpuid(leaf: u32) -> std::arch::x86_64::CpuidResult {
    // SAFETY: every processor of this architecture has the instruction.
    unsafe { std::arch::x86_64::__cpuid_count(leaf, 0) }
}

/// Whether Intel made the processor.
#[cfg(target_arch = "x86_64")]
fn is_intel() -> bool {
    let vendor = cpuid(0);
    [vendor.ebx, vendor.edx, vendor.ecx].map(u32::to_le_bytes).concat() == b"GenuineIntel"
}

/// Plain loops: the oracle of the other engines.
mod portable {
    use std::num::Wrapping;

    use super::*;
    use crate::kernels::{
        narrow::winograd::NINTH,
        winograd::{self, POWERS},
    };

    pub unsafe fn multiply(
        format: Format,
        terms: &[Term],
        position: usize,
        weights: *const Wide,
        (outputs, plane): (usize, usize),
        sums: &mut Sums,
    ) {
        for (o, sums) in sums.0[..outputs].iter_mut().enumerate() {
            for (p, sum) in sums.iter_mut().enumerate() {
                let (mut real, mut whole) = ([0.0f32; LANES], [0i32; LANES]);
                for term in terms {
                    // SAFETY: the caller's promise.
                    let (x, w) = unsafe {
                        let w = weights.byte_add(term.weights).add(o * plane);
                        (&*term.input.add(position + p), std::slice::from_raw_parts(w, LANES))
                    };
                    for (i, w) in w.iter().enumerate() {
                        for l in 0..LANES {
                            match format {
                                Format::Bf16 => {
                                    let product = |i, j| x.bf16(i).to_f32() * w.bf16(j).to_f32();
                                    real[l] += product(2 * i, 2 * l) + product(2 * i + 1, 2 * l + 1);
                                }
                                Format::Int8(_) => {
                                    let product = |c| {
                                        let w = i8::from_ne_bytes([w.0[WORD * l + c]]);
                                        i32::from(x.0[WORD * i + c]) * i32::from(w)
                                    };
                                    whole[l] += (0..WORD).map(product).sum::<i32>();
                                }
                            }
                        }
                    }
                }
                sum.0 = match format {
                    Format::Bf16 => real,
                    Format::Int8(_) => whole.map(|v| v as f32),
                };
            }
        }
    }

    pub unsafe fn evaluate(patch: [*const u8; PATCH], squares: usize, points: *mut u8, stride: usize) {
        for (square, lane) in (0..squares).flat_map(|square| (0..LANES).map(move |lane| (square, lane))) {
            // SAFETY: the caller's promise.
            unsafe {
                let columns: [[Wrapping<i16>; PATCH]; PATCH] = std::array::from_fn(|x| {
                    let at = (SIDE * square + x) * size_of::<Wide>() + lane;
                    winograd::evaluate(patch.map(|row| Wrapping(i16::from(*row.add(at)))))
                });
                for y in 0..PATCH {
                    let row = winograd::evaluate(columns.map(|column| column[y]));
                    for (x, value) in row.into_iter().enumerate() {
                        let at = ((PATCH * y + x) * stride + square) * size_of::<Wide>() + 2 * lane;
                        points.add(at).cast::<i16>().write(value.0);
                    }
                }
            }
        }
    }

    pub unsafe fn multiply_points(
        groups: &[u8],
        points: *const Wide,
        weights: *const Wide,
        squares: usize,
        products: *mut Wide,
    ) {
        for square in 0..squares {
            let mut sums = [0i32; LANES];
            for part in 0..groups.len() {
                // SAFETY: the caller's promise.
                let (x, w) = unsafe {
                    let w = std::slice::from_raw_parts(weights.add(part * LANES), LANES);
                    (&*points.add(part * SQUARES + square), w)
                };
                for (channel, l) in (0..WIDE).flat_map(|channel| (0..LANES).map(move |l| (channel, l))) {
                    let number = |wide: &Wide, i: usize| i32::from(wide.i16(i));
                    let product = number(x, channel) * number(&w[channel / 2], 2 * l + channel % 2);
                    sums[l] = sums[l].wrapping_add(product);
                }
            }
            // SAFETY: the caller's promise.
            unsafe { products.add(square).cast::<[i32; LANES]>().write(sums) };
        }
    }

    pub unsafe fn interpolate(
        products: *const Wide,
        stride: usize,
        sums: &mut [Sums; SIDE],
        (output, column): (usize, usize),
    ) {
        for lane in 0..LANES {
            // SAFETY: the caller's promise.
            unsafe {
                let lines: [[Wrapping<i32>; SIDE]; PATCH] = std::array::from_fn(|x| {
                    winograd::interpolate(std::array::from_fn(|y| {
                        Wrapping(*products.add((PATCH * y + x) * stride).cast::<i32>().add(lane))
                    }))
                });
                for (y, sums) in sums.iter_mut().enumerate() {
                    let row = winograd::interpolate(lines.map(|line| line[y]));
                    for (x, value) in row.into_iter().enumerate() {
                        let value = value.0.wrapping_mul(NINTH.cast_signed()) >> (POWERS[y] + POWERS[x]);
                        sums.0[output][column + x].0[lane] = value as f32;
                    }
                }
            }
        }
    }

    pub unsafe fn correlate(
        steps: usize,
        channels: *const bf16,
        stride: usize,
        pairs: *const Wide,
        (outputs, plane): (usize, usize),
        sums: &mut Sums,
    ) {
        for (o, sums) in sums.0[..outputs].iter_mut().enumerate() {
            for (channel, sum) in sums.iter_mut().enumerate() {
                for pair in 0..steps * CHUNK / 2 {
                    // SAFETY: the caller's promise.
                    let (x, g) = unsafe {
                        let row = channels.byte_add(channel * stride).add(2 * pair);
                        ([row.read_unaligned(), row.add(1).read_unaligned()], &*pairs.add(o * plane + pair))
                    };
                    for l in 0..LANES {
                        let g = [2 * l, 2 * l + 1].map(|i| g.bf16(i).to_f32());
                        sum.0[l] += x[0].to_f32() * g[0] + x[1].to_f32() * g[1];
                    }
                }
            }
        }
    }

    pub unsafe fn narrow_spread(low: &[Block], high: Option<&[Block]>, out: *mut Wide, step: usize) {
        for (i, low) in low.iter().enumerate() {
            let mut both = Wide::ZERO;
            for l in 0..LANES {
                both.set_bf16(l, bf16::from_f32(low.0[l]));
                both.set_bf16(LANES + l, high.map_or(bf16::ZERO, |h| bf16::from_f32(h[i].0[l])));
            }
            // SAFETY: the caller's promise.
            unsafe { out.add(i * step).write(both) };
        }
    }

    pub fn interleave(pairs: &[[Block; 2]], out: &mut [Wide]) {
        for (pair, out) in pairs.iter().zip(out) {
            for l in 0..LANES {
                out.set_bf16(2 * l, bf16::from_f32(pair[0].0[l]));
                out.set_bf16(2 * l + 1, bf16::from_f32(pair[1].0[l]));
            }
        }
    }

    pub unsafe fn transpose(blocks: &[Block], rows: *mut bf16, stride: usize) {
        for c in 0..LANES {
            for i in 0..LANES {
                let value = blocks.get(i).map_or(bf16::ZERO, |b| bf16::from_f32(b.0[c]));
                // SAFETY: the caller's promise.
                unsafe { rows.add(c * stride + i).write(value) };
            }
        }
    }
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use std::arch::x86_64::*;

    use super::{CHUNK, GROUP, LANES, PATCH, SIDE, SQUARES, Sums, Term, WORD, Wide};
    use crate::kernels::{
        narrow::winograd::NINTH,
        winograd::{self, POWERS, Ring},
    };

    /// Positions whose sums stay in registers, two for each.
    const TILE: usize = 4;

    /// Squares whose products stay in registers, two for each.
    const STRIP: usize = 4;

    /// Lanes of a register.
    const HALF: usize = LANES / 2;

    /// The products of the words of two rows.
    trait Product {
        /// `acc[i] + sum over rows r and j of x[r][i][j] w[r][i][j]`.
        ///
        /// # Safety
        /// The processor has the instructions.
        unsafe fn add(acc: __m256i, x: [__m256i; 2], w: [__m256i; 2]) -> __m256i;
    }

    /// Two products of each row add up in 16 bits, as weights are made to fit into
    /// ([`FITTING_STEPS`](super::super::FITTING_STEPS)), then in 32.
    struct Words;

    impl Product for Words {
        #[inline(always)]
        unsafe fn add(acc: __m256i, x: [__m256i; 2], w: [__m256i; 2]) -> __m256i {
            // SAFETY: the caller's promise.
            unsafe {
                let [a, b] = [0, 1].map(|r| _mm256_maddubs_epi16(x[r], w[r]));
                _mm256_add_epi32(acc, _mm256_madd_epi16(_mm256_add_epi16(a, b), _mm256_set1_epi16(1)))
            }
        }
    }

    /// AVX-VNNI.
    struct Vnni;

    impl Product for Vnni {
        #[inline(always)]
        unsafe fn add(acc: __m256i, x: [__m256i; 2], w: [__m256i; 2]) -> __m256i {
            // SAFETY: the caller's promise.
            unsafe { _mm256_dpbusd_avx_epi32(_mm256_dpbusd_avx_epi32(acc, x[0], w[0]), x[1], w[1]) }
        }
    }

    #[target_feature(enable = "avx2")]
    pub unsafe fn multiply(
        terms: (&[Term], &[u8]),
        position: usize,
        weights: *const Wide,
        outputs: (usize, usize),
        sums: &mut Sums,
    ) {
        // SAFETY: the caller's promise.
        unsafe { tiles::<Words>(terms, position, weights, outputs, sums) }
    }

    #[target_feature(enable = "avx2,avxvnni")]
    pub unsafe fn multiply_vnni(
        terms: (&[Term], &[u8]),
        position: usize,
        weights: *const Wide,
        outputs: (usize, usize),
        sums: &mut Sums,
    ) {
        // SAFETY: the caller's promise.
        unsafe { tiles::<Vnni>(terms, position, weights, outputs, sums) }
    }

    /// # Safety
    /// As [`super::Engine::multiply`], and the processor has the instructions of `P`.
    #[inline(always)]
    unsafe fn tiles<P: Product>(
        (terms, groups): (&[Term], &[u8]),
        position: usize,
        weights: *const Wide,
        (outputs, plane): (usize, usize),
        sums: &mut Sums,
    ) {
        for (o, sums) in sums.0[..outputs].iter_mut().enumerate() {
            for (tile, sums) in sums.as_chunks_mut::<TILE>().0.iter_mut().enumerate() {
                // SAFETY: the caller's promise; a block is two registers.
                unsafe {
                    let mut acc = [[_mm256_setzero_si256(); 2]; TILE];
                    for (term, &groups) in terms.iter().zip(groups) {
                        let mut x = term.input.add(position + tile * TILE).cast::<u8>();
                        let mut w = weights.byte_add(term.weights).add(o * plane).cast::<__m256i>();
                        for _ in 0..GROUP / 2 * usize::from(groups) {
                            let row = |at: usize| [0, 1].map(|row| _mm256_load_si256(w.add(2 * row + at)));
                            let w_of = [row(0), row(1)];
                            for (p, acc) in acc.iter_mut().enumerate() {
                                let x = [0, 1].map(|row| {
                                    let x = x.add(p * size_of::<Wide>() + WORD * row);
                                    _mm256_set1_epi32(x.cast::<i32>().read_unaligned())
                                });
                                *acc = [P::add(acc[0], x, w_of[0]), P::add(acc[1], x, w_of[1])];
                            }
                            (x, w) = (x.add(2 * WORD), w.add(4));
                        }
                    }
                    for (sum, acc) in sums.iter_mut().zip(acc) {
                        for (half, acc) in acc.into_iter().enumerate() {
                            _mm256_store_ps(sum.0[half * HALF..].as_mut_ptr(), _mm256_cvtepi32_ps(acc));
                        }
                    }
                }
            }
        }
        const { assert!(CHUNK.is_multiple_of(TILE)) };
    }

    /// 16 numbers of 16 bits.
    #[derive(Clone, Copy)]
    struct Halves(__m256i);

    /// 8 of 32 bits.
    #[derive(Clone, Copy)]
    struct Wholes(__m256i);

    macro_rules! ring {
        ($numbers:ident, $add:ident, $subtract:ident) => {
            impl Ring for $numbers {
                #[inline(always)]
                unsafe fn plus(self, other: Self) -> Self {
                    // SAFETY: the caller's promise, here and below.
                    unsafe { Self($add(self.0, other.0)) }
                }
                #[inline(always)]
                unsafe fn minus(self, other: Self) -> Self {
                    // SAFETY: as above.
                    unsafe { Self($subtract(self.0, other.0)) }
                }
                #[inline(always)]
                unsafe fn twice(self) -> Self {
                    // SAFETY: as above.
                    unsafe { Self($add(self.0, self.0)) }
                }
            }
        };
    }
    ring!(Halves, _mm256_add_epi16, _mm256_sub_epi16);
    ring!(Wholes, _mm256_add_epi32, _mm256_sub_epi32);

    #[target_feature(enable = "avx2")]
    pub unsafe fn evaluate(patch: [*const u8; PATCH], squares: usize, points: *mut u8, stride: usize) {
        let nothing = Halves(_mm256_setzero_si256());
        // Columns of a patch at the points, the last two of which are the next patch's first.
        let mut columns = [[nothing; PATCH]; PATCH];
        for square in 0..squares {
            // SAFETY: the caller's promise; sixteen channels are aligned to as many bytes, and to twice that as points.
            unsafe {
                for x in if square == 0 { 0 } else { PATCH - SIDE }..PATCH {
                    let mut column = [nothing; PATCH];
                    for y in 0..PATCH {
                        let bytes = patch[y].add((SIDE * square + x) * size_of::<Wide>());
                        column[y] = Halves(_mm256_cvtepu8_epi16(_mm_load_si128(bytes.cast())));
                    }
                    columns[x] = winograd::evaluate(column);
                }
                for y in 0..PATCH {
                    let mut row = [nothing; PATCH];
                    for x in 0..PATCH {
                        row[x] = columns[x][y];
                    }
                    let row = winograd::evaluate(row);
                    for x in 0..PATCH {
                        let at = ((PATCH * y + x) * stride + square) * size_of::<Wide>();
                        _mm256_store_si256(points.add(at).cast(), row[x].0);
                    }
                }
            }
            columns.copy_within(SIDE.., 0);
        }
    }

    #[target_feature(enable = "avx2")]
    pub unsafe fn multiply_points(
        groups: &[u8],
        points: *const Wide,
        weights: *const Wide,
        squares: usize,
        products: *mut Wide,
    ) {
        for first in (0..squares).step_by(STRIP) {
            // SAFETY: the caller's promise; a value is two registers.
            unsafe {
                let mut acc = [[_mm256_setzero_si256(); 2]; STRIP];
                for (part, &groups) in groups.iter().enumerate() {
                    let mut x = points.add(part * SQUARES + first).cast::<u8>();
                    let mut w = weights.add(part * LANES).cast::<__m256i>();
                    for _ in 0..groups {
                        for row in 0..GROUP {
                            let [low, high] = [0, 1].map(|half| _mm256_load_si256(w.add(2 * row + half)));
                            for (p, acc) in acc.iter_mut().enumerate() {
                                let x = x.add(p * size_of::<Wide>() + WORD * row);
                                let x = _mm256_set1_epi32(x.cast::<i32>().read_unaligned());
                                acc[0] = _mm256_add_epi32(acc[0], _mm256_madd_epi16(x, low));
                                acc[1] = _mm256_add_epi32(acc[1], _mm256_madd_epi16(x, high));
                            }
                        }
                        (x, w) = (x.add(WORD * GROUP), w.add(2 * GROUP));
                    }
                }
                for (p, acc) in acc.iter().enumerate() {
                    let to = products.add(first + p).cast::<__m256i>();
                    _mm256_store_si256(to, acc[0]);
                    _mm256_store_si256(to.add(1), acc[1]);
                }
            }
        }
        const { assert!(SQUARES.is_multiple_of(STRIP)) };
    }

    #[target_feature(enable = "avx2")]
    pub unsafe fn interpolate(
        products: *const Wide,
        stride: usize,
        sums: &mut [Sums; SIDE],
        (output, column): (usize, usize),
    ) {
        let nothing = Wholes(_mm256_setzero_si256());
        let ninth = _mm256_set1_epi32(NINTH.cast_signed());
        for half in 0..2 {
            let mut lines = [[nothing; SIDE]; PATCH];
            for x in 0..PATCH {
                let mut line = [nothing; PATCH];
                // SAFETY: the caller's promise; half a value is a register.
                unsafe {
                    for y in 0..PATCH {
                        let product = products.add((PATCH * y + x) * stride).cast::<__m256i>();
                        line[y] = Wholes(_mm256_load_si256(product.add(half)));
                    }
                    lines[x] = winograd::interpolate(line);
                }
            }
            for (y, sums) in sums.iter_mut().enumerate() {
                let mut row = [nothing; PATCH];
                for x in 0..PATCH {
                    row[x] = lines[x][y];
                }
                // SAFETY: the instructions are this function's; half a block is a register.
                unsafe {
                    let row = winograd::interpolate(row);
                    for x in 0..SIDE {
                        let power = _mm_cvtsi32_si128((POWERS[y] + POWERS[x]).cast_signed());
                        let sum = _mm256_sra_epi32(_mm256_mullo_epi32(row[x].0, ninth), power);
                        let to = &mut sums.0[output][column + x].0[half * HALF..];
                        _mm256_store_ps(to.as_mut_ptr(), _mm256_cvtepi32_ps(sum));
                    }
                }
            }
        }
    }
}

#[cfg(target_arch = "x86_64")]
mod avx512 {
    use std::arch::x86_64::*;

    use super::{Block, CHUNK, GROUP, LANES, Sums, Term, WORD, Wide, bf16};
    use crate::kernels::simd::{Avx512, Simd};

    /// Sums that stay in registers, of the positions of a tile for one output plane or two, beside as many registers of weights.
    /// Fewer would wait for each other.
    const SUMS: usize = 16;

    /// The products of the pairs or fours of values of a vector, added up for every lane.
    trait Product {
        /// `acc[i] + sum over j of x[i][j] w[i][j]`.
        ///
        /// # Safety
        /// The processor has the instructions.
        unsafe fn add(acc: __m512, x: __m512i, w: __m512i) -> __m512;

        /// Sums as f32.
        ///
        /// # Safety
        /// As above.
        unsafe fn sums(acc: __m512) -> __m512;
    }

    /// Pairs of bfloat16.
    struct Bf16;

    impl Product for Bf16 {
        #[inline(always)]
        unsafe fn add(acc: __m512, x: __m512i, w: __m512i) -> __m512 {
            // SAFETY: the caller's promise.
            unsafe {
                let [x, w] = [x, w].map(|v| std::mem::transmute::<__m512i, __m512bh>(v));
                _mm512_dpbf16_ps(acc, w, x)
            }
        }

        #[inline(always)]
        unsafe fn sums(acc: __m512) -> __m512 {
            acc
        }
    }

    /// Fours of 8 bits, whose sums are whole numbers.
    struct Int8;

    impl Product for Int8 {
        #[inline(always)]
        unsafe fn add(acc: __m512, x: __m512i, w: __m512i) -> __m512 {
            // SAFETY: the caller's promise.
            unsafe { _mm512_castsi512_ps(_mm512_dpbusd_epi32(_mm512_castps_si512(acc), x, w)) }
        }

        #[inline(always)]
        unsafe fn sums(acc: __m512) -> __m512 {
            // SAFETY: the caller's promise.
            unsafe { _mm512_cvtepi32_ps(_mm512_castps_si512(acc)) }
        }
    }

    #[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
    pub unsafe fn multiply_bf16(
        terms: (&[Term], &[u8]),
        position: usize,
        weights: *const Wide,
        outputs: (usize, usize),
        sums: &mut Sums,
    ) {
        // SAFETY: the caller's promise.
        unsafe { multiply::<Bf16>(terms, position, weights, outputs, sums) }
    }

    #[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
    pub unsafe fn multiply_int8(
        terms: (&[Term], &[u8]),
        position: usize,
        weights: *const Wide,
        outputs: (usize, usize),
        sums: &mut Sums,
    ) {
        // SAFETY: the caller's promise.
        unsafe { multiply::<Int8>(terms, position, weights, outputs, sums) }
    }

    /// # Safety
    /// As [`Engine::multiply`], and the processor has the instructions of `P`.
    #[inline(always)]
    unsafe fn multiply<P: Product>(
        terms: (&[Term], &[u8]),
        position: usize,
        weights: *const Wide,
        (outputs, plane): (usize, usize),
        sums: &mut Sums,
    ) {
        // SAFETY: the caller's promise.
        unsafe {
            if outputs == 2 {
                tiles::<P, 2, { SUMS / 2 }>(terms, position, weights, plane, sums);
            } else {
                tiles::<P, 1, SUMS>(terms, position, weights, plane, sums);
            }
        }
    }

    /// # Safety
    /// As [`Engine::multiply`], and the processor has the instructions of `P`.
    #[inline(always)]
    unsafe fn tiles<P: Product, const OUT: usize, const TILE: usize>(
        (terms, groups): (&[Term], &[u8]),
        position: usize,
        weights: *const Wide,
        plane: usize,
        sums: &mut Sums,
    ) {
        for first in (0..CHUNK).step_by(TILE) {
            // SAFETY: the caller's promise.
            unsafe {
                let mut acc = [[_mm512_setzero_ps(); TILE]; OUT];
                for (term, &groups) in terms.iter().zip(groups) {
                    let mut x = term.input.add(position + first).cast::<u8>();
                    let mut w = weights.byte_add(term.weights);
                    for _ in 0..groups {
                        for row in 0..GROUP {
                            add_row::<P, OUT, TILE>(
                                &mut acc,
                                x.add(WORD * row),
                                size_of::<Wide>(),
                                w.add(row),
                                plane,
                            );
                        }
                        (x, w) = (x.add(WORD * GROUP), w.add(GROUP));
                    }
                }
                store::<P, OUT, TILE>(&acc, sums, first);
            }
        }
    }

    /// Adds the products of a word of each of a tile's rows, `stride` bytes apart from `x` on, with those in
    /// `w` of each output plane, `plane` rows apart.
    ///
    /// # Safety
    /// All of them can be read; the processor has the instructions of `P`.
    #[inline(always)]
    unsafe fn add_row<P: Product, const OUT: usize, const TILE: usize>(
        acc: &mut [[__m512; TILE]; OUT],
        x: *const u8,
        stride: usize,
        w: *const Wide,
        plane: usize,
    ) {
        // SAFETY: the caller's promise.
        unsafe {
            let w: [__m512i; OUT] = std::array::from_fn(|o| _mm512_load_si512(w.add(o * plane).cast()));
            for row in 0..TILE {
                let x = _mm512_set1_epi32(x.add(row * stride).cast::<i32>().read_unaligned());
                for o in 0..OUT {
                    acc[o][row] = P::add(acc[o][row], x, w[o]);
                }
            }
        }
    }

    /// Stores a tile whose first row is row `first` of the sums.
    ///
    /// # Safety
    /// The processor has the instructions of `P`.
    #[inline(always)]
    unsafe fn store<P: Product, const OUT: usize, const TILE: usize>(
        acc: &[[__m512; TILE]; OUT],
        sums: &mut Sums,
        first: usize,
    ) {
        for (acc, sums) in acc.iter().zip(&mut sums.0) {
            for (acc, sum) in acc.iter().zip(&mut sums[first..]) {
                // SAFETY: the caller's promise; a block is 64 bytes, aligned to as many.
                unsafe { _mm512_store_ps(sum.0.as_mut_ptr(), P::sums(*acc)) };
            }
        }
    }

    #[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
    pub unsafe fn correlate(
        steps: usize,
        channels: *const bf16,
        stride: usize,
        pairs: *const Wide,
        (outputs, plane): (usize, usize),
        sums: &mut Sums,
    ) {
        // SAFETY: the caller's promise.
        unsafe {
            if outputs == 2 {
                correlate_tiles::<2, { SUMS / 2 }>(steps, channels, stride, pairs, plane, sums);
            } else {
                correlate_tiles::<1, SUMS>(steps, channels, stride, pairs, plane, sums);
            }
        }
    }

    #[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
    #[inline]
    unsafe fn correlate_tiles<const OUT: usize, const TILE: usize>(
        steps: usize,
        channels: *const bf16,
        stride: usize,
        pairs: *const Wide,
        plane: usize,
        sums: &mut Sums,
    ) {
        for first in (0..CHUNK).step_by(TILE) {
            // SAFETY: the caller's promise; a block is 64 bytes, aligned to as many.
            unsafe {
                let mut acc: [[__m512; TILE]; OUT] = std::array::from_fn(|o| {
                    std::array::from_fn(|c| _mm512_load_ps(sums.0[o][first + c].0.as_ptr()))
                });
                let rows = channels.byte_add(first * stride).cast::<u8>();
                for pair in 0..steps * CHUNK / 2 {
                    add_row::<Bf16, OUT, TILE>(
                        &mut acc,
                        rows.add(WORD * pair),
                        stride,
                        pairs.add(pair),
                        plane,
                    );
                }
                store::<Bf16, OUT, TILE>(&acc, sums, first);
            }
        }
    }

    #[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
    pub unsafe fn narrow_spread(low: &[Block], high: Option<&[Block]>, out: *mut Wide, step: usize) {
        for (i, low) in low.iter().enumerate() {
            // SAFETY: the caller's promise; blocks and wides are 64 bytes, aligned to as many.
            unsafe {
                let low = _mm512_load_ps(low.0.as_ptr());
                let high = high.map_or(_mm512_setzero_ps(), |h| _mm512_load_ps(h[i].0.as_ptr()));
                let both: __m512i = std::mem::transmute(_mm512_cvtne2ps_pbh(high, low));
                _mm512_store_si512(out.add(i * step).cast(), both);
            }
        }
    }

    #[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
    pub unsafe fn interleave(pairs: &[[Block; 2]], out: &mut [Wide]) {
        for (pair, out) in pairs.iter().zip(out) {
            // SAFETY: blocks and wides are 64 bytes, aligned to as many.
            unsafe {
                let [a, b] = [0, 1].map(|i| {
                    let half: __m256i =
                        std::mem::transmute(_mm512_cvtneps_pbh(_mm512_load_ps(pair[i].0.as_ptr())));
                    _mm512_cvtepu16_epi32(half)
                });
                let both = _mm512_or_si512(a, _mm512_slli_epi32::<16>(b));
                _mm512_store_si512(out.0.as_mut_ptr().cast(), both);
            }
        }
    }

    #[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
    pub unsafe fn transpose(blocks: &[Block], rows: *mut bf16, stride: usize) {
        let mut r: [__m512; LANES] = [_mm512_setzero_ps(); LANES];
        for (r, block) in r.iter_mut().zip(blocks) {
            // SAFETY: a block is 64 bytes, aligned to as many.
            *r = unsafe { _mm512_load_ps(block.0.as_ptr()) };
        }
        // SAFETY: these instructions are among this function's.
        let r = unsafe { Avx512::transpose(r) };
        for (c, r) in r.iter().enumerate() {
            // SAFETY: the caller's promise.
            unsafe {
                let row: __m256i = std::mem::transmute(_mm512_cvtneps_pbh(*r));
                _mm256_storeu_si256(rows.add(c * stride).cast(), row);
            }
        }
    }
}

#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
mod amx {
    use std::{arch::asm, sync::OnceLock};

    use super::*;

    /// Whether the processor has AMX-BF16 and the kernel lets this process use it.
    pub fn permitted() -> bool {
        /// Bits of CPUID leaf 7, EDX.
        const AMX_BF16: u32 = 1 << 22;
        const AMX_TILE: u32 = 1 << 24;
        /// The tile data's bit among the extended states, and the request for it (Linux 5.16).
        const TILE_DATA: libc::c_ulong = 18;
        const ARCH_REQ_XCOMP_PERM: libc::c_ulong = 0x1023;
        static PERMITTED: OnceLock<bool> = OnceLock::new();
        *PERMITTED.get_or_init(|| {
            if cpuid(0).eax < 7 {
                return false;
            }
            let features = cpuid(7).edx;
            // SAFETY: the call only sets a permission of this process; older kernels refuse it.
            features & AMX_BF16 != 0
                && features & AMX_TILE != 0
                && unsafe { libc::syscall(libc::SYS_arch_prctl, ARCH_REQ_XCOMP_PERM, TILE_DATA) } == 0
        })
    }

    /// Bytes of a tile's row, and of a tile.
    const ROW: usize = 64;
    const TILE: usize = 16 * ROW;

    /// Eight tiles of 16 rows of 64 bytes, while it lives.
    pub struct Tiles;

    impl Tiles {
        pub fn configure() -> Self {
            #[repr(C, align(64))]
            struct Config([u8; 64]);
            let mut config = Config([0; 64]);
            config.0[0] = 1;
            for tile in 0..8 {
                config.0[16 + 2 * tile] = ROW as u8;
                config.0[48 + tile] = 16;
            }
            // SAFETY: the palette is the architecture's only one; an AMX engine exists, so the state is
            // permitted.
            unsafe { asm!("ldtilecfg [{}]", in(reg) &config, options(nostack, readonly)) };
            Tiles
        }
    }

    impl Drop for Tiles {
        fn drop(&mut self) {
            // SAFETY: gives the tile state back, so that later context switches need not save it.
            unsafe { asm!("tilerelease", options(nostack, nomem)) };
        }
    }

    pub unsafe fn multiply(
        terms: &[Term],
        position: usize,
        weights: *const Wide,
        (outputs, plane): (usize, usize),
        sums: &mut Sums,
    ) {
        debug_assert!(!terms.is_empty());
        // SAFETY: the caller's promise; the loops run over `terms`, which are not empty; the sums of an
        // output plane are two tiles.
        unsafe {
            if outputs == 2 {
                asm!(
                    "tilezero tmm0",
                    "tilezero tmm1",
                    "tilezero tmm2",
                    "tilezero tmm3",
                    "2:",
                    "mov {x}, qword ptr [{term}]",
                    "mov {w}, qword ptr [{term} + 8]",
                    "add {x}, {input}",
                    "add {w}, {weights}",
                    "tileloadd tmm4, [{x} + {row}*1]",
                    "tileloadd tmm6, [{w} + {row}*1]",
                    "add {w}, {plane}",
                    "tileloadd tmm5, [{x} + {row}*1 + 1024]",
                    "tileloadd tmm7, [{w} + {row}*1]",
                    "add {term}, 16",
                    "tdpbf16ps tmm0, tmm4, tmm6",
                    "tdpbf16ps tmm1, tmm5, tmm6",
                    "tdpbf16ps tmm2, tmm4, tmm7",
                    "tdpbf16ps tmm3, tmm5, tmm7",
                    "cmp {term}, {end}",
                    "jne 2b",
                    "tilestored [{sums} + {row}*1], tmm0",
                    "tilestored [{sums} + {row}*1 + 1024], tmm1",
                    "tilestored [{sums} + {row}*1 + 2048], tmm2",
                    "tilestored [{sums} + {row}*1 + 3072], tmm3",
                    x = out(reg) _,
                    w = out(reg) _,
                    term = inout(reg) terms.as_ptr() => _,
                    end = in(reg) terms.as_ptr_range().end,
                    input = in(reg) position * ROW,
                    weights = in(reg) weights,
                    plane = in(reg) plane * ROW,
                    row = in(reg) ROW,
                    sums = in(reg) sums,
                    options(nostack)
                );
            } else {
                asm!(
                    "tilezero tmm0",
                    "tilezero tmm1",
                    "2:",
                    "mov {x}, qword ptr [{term}]",
                    "mov {w}, qword ptr [{term} + 8]",
                    "add {x}, {input}",
                    "add {w}, {weights}",
                    "tileloadd tmm4, [{x} + {row}*1]",
                    "tileloadd tmm6, [{w} + {row}*1]",
                    "tileloadd tmm5, [{x} + {row}*1 + 1024]",
                    "add {term}, 16",
                    "tdpbf16ps tmm0, tmm4, tmm6",
                    "tdpbf16ps tmm1, tmm5, tmm6",
                    "cmp {term}, {end}",
                    "jne 2b",
                    "tilestored [{sums} + {row}*1], tmm0",
                    "tilestored [{sums} + {row}*1 + 1024], tmm1",
                    x = out(reg) _,
                    w = out(reg) _,
                    term = inout(reg) terms.as_ptr() => _,
                    end = in(reg) terms.as_ptr_range().end,
                    input = in(reg) position * ROW,
                    weights = in(reg) weights,
                    row = in(reg) ROW,
                    sums = in(reg) sums,
                    options(nostack)
                );
            }
        }
    }

    pub unsafe fn correlate(
        steps: usize,
        channels: *const bf16,
        stride: usize,
        pairs: *const Wide,
        (outputs, plane): (usize, usize),
        sums: &mut Sums,
    ) {
        debug_assert!(steps > 0);
        // SAFETY: the caller's promise; `steps` is not zero.
        unsafe {
            let upper = channels.byte_add(16 * stride);
            if outputs == 2 {
                asm!(
                    "tileloadd tmm0, [{sums} + {row}*1]",
                    "tileloadd tmm1, [{sums} + {row}*1 + 1024]",
                    "tileloadd tmm2, [{sums} + {row}*1 + 2048]",
                    "tileloadd tmm3, [{sums} + {row}*1 + 3072]",
                    "2:",
                    "tileloadd tmm4, [{x} + {stride}*1]",
                    "tileloadd tmm6, [{w} + {row}*1]",
                    "tileloadd tmm5, [{y} + {stride}*1]",
                    "tileloadd tmm7, [{v} + {row}*1]",
                    "add {x}, 64",
                    "add {y}, 64",
                    "add {w}, 1024",
                    "add {v}, 1024",
                    "tdpbf16ps tmm0, tmm4, tmm6",
                    "tdpbf16ps tmm1, tmm5, tmm6",
                    "tdpbf16ps tmm2, tmm4, tmm7",
                    "tdpbf16ps tmm3, tmm5, tmm7",
                    "dec {steps}",
                    "jnz 2b",
                    "tilestored [{sums} + {row}*1], tmm0",
                    "tilestored [{sums} + {row}*1 + 1024], tmm1",
                    "tilestored [{sums} + {row}*1 + 2048], tmm2",
                    "tilestored [{sums} + {row}*1 + 3072], tmm3",
                    x = inout(reg) channels => _,
                    y = inout(reg) upper => _,
                    w = inout(reg) pairs => _,
                    v = inout(reg) pairs.add(plane) => _,
                    steps = inout(reg) steps => _,
                    stride = in(reg) stride,
                    row = in(reg) ROW,
                    sums = in(reg) sums,
                    options(nostack)
                );
            } else {
                asm!(
                    "tileloadd tmm0, [{sums} + {row}*1]",
                    "tileloadd tmm1, [{sums} + {row}*1 + 1024]",
                    "2:",
                    "tileloadd tmm4, [{x} + {stride}*1]",
                    "tileloadd tmm6, [{w} + {row}*1]",
                    "tileloadd tmm5, [{y} + {stride}*1]",
                    "add {x}, 64",
                    "add {y}, 64",
                    "add {w}, 1024",
                    "tdpbf16ps tmm0, tmm4, tmm6",
                    "tdpbf16ps tmm1, tmm5, tmm6",
                    "dec {steps}",
                    "jnz 2b",
                    "tilestored [{sums} + {row}*1], tmm0",
                    "tilestored [{sums} + {row}*1 + 1024], tmm1",
                    x = inout(reg) channels => _,
                    y = inout(reg) upper => _,
                    w = inout(reg) pairs => _,
                    steps = inout(reg) steps => _,
                    stride = in(reg) stride,
                    row = in(reg) ROW,
                    sums = in(reg) sums,
                    options(nostack)
                );
            }
        }
        const { assert!(TILE == 1024 && size_of::<Sums>() == 4 * TILE && size_of::<Term>() == 16) };
        const { assert!(size_of::<Wide>() == ROW && WIDE == 32) };
    }
}
