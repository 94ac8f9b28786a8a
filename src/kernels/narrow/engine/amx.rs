//! AMX: matrix tiles of 16 rows of 64 bytes. An instruction does 8192 multiply-accumulates of bfloat16
//! (AMX-BF16) or 16384 of 8 bits (AMX-INT8). Conversions are those of the AVX-512 engine.

#[cfg(test)]
mod emulation;

use std::{
    arch::{
        asm,
        x86_64::{_mm512_cvtepi32_ps, _mm512_load_si512, _mm512_store_ps},
    },
    sync::OnceLock,
};

use half::bf16;

use super::{Backend, Correlation, Product, avx512::Avx512, cpuid};
use crate::kernels::{
    Block,
    narrow::{Sums, Term, WIDE, Wide},
};

/// Eight tiles of 16 rows of 64 bytes.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Amx(Avx512);

impl Backend for Amx {
    const NAME: &str = "Amx";

    fn detect() -> Option<Self> {
        Avx512::detect().filter(|_| permitted()).map(Self)
    }

    fn prefers_bf16(self) -> bool {
        true
    }

    /// An instruction multiplies twice as many factors of 8 bits as of bfloat16, and the sums are the same
    /// whole numbers as those of AVX512-VNNI and of plain loops. It is not timed yet on such a processor.
    fn prefers_int8(self) -> bool {
        true
    }

    fn ready<R>(self, work: impl FnOnce() -> R) -> R {
        let _tiles = Tiles::configure();
        work()
    }

    #[target_feature(enable = "avx512f")]
    unsafe fn multiply_int8(self, product: Product, sums: &mut Sums) {
        // SAFETY: the caller's promise; a block is 64 bytes, aligned to as many.
        unsafe {
            multiply_bytes(product, sums);
            for block in sums.0[..product.outputs].as_flattened_mut() {
                let whole = _mm512_load_si512(block.0.as_ptr().cast());
                _mm512_store_ps(block.0.as_mut_ptr(), _mm512_cvtepi32_ps(whole));
            }
        }
    }

    unsafe fn multiply_bf16(self, product: Product, sums: &mut Sums) {
        // SAFETY: the caller's promise.
        unsafe { multiply_pairs(product, sums) }
    }

    unsafe fn correlate(self, correlation: Correlation, sums: &mut Sums) {
        let Correlation { steps, channels, stride, pairs, outputs, plane } = correlation;
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
    }

    unsafe fn narrow_spread(self, low: &[Block], high: Option<&[Block]>, out: *mut Wide, step: usize) {
        // SAFETY: the caller's promise.
        unsafe { self.0.narrow_spread(low, high, out, step) }
    }

    fn interleave(self, pairs: &[[Block; 2]], out: &mut [Wide]) {
        self.0.interleave(pairs, out);
    }

    unsafe fn transpose(self, blocks: &[Block], rows: *mut bf16, stride: usize) {
        // SAFETY: the caller's promise.
        unsafe { self.0.transpose(blocks, rows, stride) }
    }
}

/// Bytes of a tile's row, and of a tile.
const ROW: usize = 64;
const TILE: usize = 16 * ROW;

// What the loops take for granted.
const _: () = assert!(TILE == 1024 && size_of::<Sums>() == 4 * TILE && size_of::<Term>() == 16);
const _: () = assert!(size_of::<Wide>() == ROW && WIDE == 32);

/// A function that computes the sums of a [`Product`] by an instruction that multiplies two tiles and adds to
/// a third. Whatever the format, a row of inputs and a row of weights are 64 bytes, and the sums are two
/// tiles an output plane. So the instruction is all that differs. Rows of weights that [`Product::groups`]
/// leaves out are zero, so that they may be multiplied as well.
macro_rules! multiplication {
    ($name:ident, $instruction:literal) => {
        /// # Safety
        /// As [`super::Engine::multiply`], on a processor that has the instruction.
        unsafe fn $name(product: Product, sums: &mut Sums) {
            let Product { terms, position, weights, outputs, plane, .. } = product;
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
                        concat!($instruction, " tmm0, tmm4, tmm6"),
                        concat!($instruction, " tmm1, tmm5, tmm6"),
                        concat!($instruction, " tmm2, tmm4, tmm7"),
                        concat!($instruction, " tmm3, tmm5, tmm7"),
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
                        concat!($instruction, " tmm0, tmm4, tmm6"),
                        concat!($instruction, " tmm1, tmm5, tmm6"),
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
    };
}

// Fours of 8 bits: inputs (the second operand) without a sign, weights (the third) with one. The sums are
// whole numbers.
multiplication!(multiply_bytes, "tdpbusd");
// Pairs of bfloat16.
multiplication!(multiply_pairs, "tdpbf16ps");

/// Whether the processor has AMX-BF16 and AMX-INT8, and the system's kernel lets this process use it.
fn permitted() -> bool {
    /// Bits of CPUID leaf 7, EDX.
    const AMX_BF16: u32 = 1 << 22;
    const AMX_TILE: u32 = 1 << 24;
    const AMX_INT8: u32 = 1 << 25;
    const AMX: u32 = AMX_BF16 | AMX_TILE | AMX_INT8;
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
        features & AMX == AMX
            && unsafe { libc::syscall(libc::SYS_arch_prctl, ARCH_REQ_XCOMP_PERM, TILE_DATA) } == 0
    })
}

/// Keeps eight tiles of 16 rows of 64 bytes configured on this thread while it lives.
struct Tiles;

impl Tiles {
    fn configure() -> Self {
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

#[cfg(test)]
mod tests {
    use super::{
        super::{Engine, Unit},
        *,
    };
    use crate::kernels::{
        LANES, Shape, View, ViewMut,
        conv::{Epilogue, Geometry},
        layout::to_blocked,
        narrow::{
            CHUNK, Format, Operand, Steps,
            conv::{Output, Weights, convolve},
        },
    };

    const INT8: Format = Format::Int8(Steps { step: 1.0, zero: 0 });

    /// The engine on the processor's own tiles, or on emulated ones where it has none. All else that the
    /// engine does needs AVX-512 either way.
    fn engine() -> Option<Engine> {
        let amx = Amx::detect().or_else(|| {
            let vectors = Avx512::detect()?;
            emulation::install();
            Some(Amx(vectors))
        });
        if amx.is_none() {
            println!("skipped: this processor has no AVX512-BF16");
        }
        amx.map(|amx| Engine(Unit::Amx(amx)))
    }

    /// A reproducible stream of 32 bits each.
    fn random(seed: u64) -> impl FnMut() -> u32 {
        let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
        move || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 32) as u32
        }
    }

    /// Between -1 and 1.
    fn real(bits: u32) -> f32 {
        (bits >> 8) as f32 / (1 << 23) as f32 - 1.0
    }

    /// Rows of values of a format. In 8 bits every other value is an extreme one, with a sign or without.
    fn rows(format: Format, len: usize, next: &mut impl FnMut() -> u32) -> Vec<Wide> {
        let mut row = || {
            let mut row = Wide::ZERO;
            match format {
                Format::Bf16 => (0..WIDE).for_each(|i| row.set_bf16(i, bf16::from_f32(real(next())))),
                Format::Int8(_) => row.0.fill_with(|| match next().to_le_bytes() {
                    [value, _, _, 0..128] => value,
                    [_, i, ..] => [0, 255, 128, 127][usize::from(i % 4)],
                }),
            }
            row
        };
        (0..len).map(|_| row()).collect()
    }

    /// Sums with something in them, which products overwrite and correlations add to.
    fn untouched() -> Sums {
        Sums([[Block([-0.5; LANES]); CHUNK]; 2])
    }

    fn values(sums: &Sums) -> Vec<f32> {
        sums.0.as_flattened().iter().flat_map(|block| block.0).collect()
    }

    fn bits(values: &[f32]) -> Vec<u32> {
        values.iter().map(|value| value.to_bits()).collect()
    }

    /// As `tests/kernels.rs` has it.
    fn assert_close(got: &[f32], want: &[f32], what: &str) {
        let scale = want.iter().fold(1e-3f32, |m, v| m.max(v.abs()));
        for (i, (g, w)) in got.iter().zip(want).enumerate() {
            assert!((g - w).abs() <= 2e-5 * scale, "{what}: element {i}: {g} for {w}");
        }
    }

    /// The sums of a product of several terms as the tiles and as the portable engine compute them, for every
    /// number of output planes.
    fn products(engine: Engine, format: Format, check: impl Fn(&[f32], &[f32], &str)) {
        let cases = |count| [(count, 1, 0), (count, 2, 0), (count, 1, 7), (count, 2, 40)];
        for (count, outputs, position) in [1, 2, 9].into_iter().flat_map(cases) {
            let mut next = random((count + outputs) as u64);
            let inputs = rows(format, count * (position + CHUNK), &mut next);
            // The weights begin at another row than the first, and their planes lie further apart than they
            // are long.
            let plane = count * LANES + 3;
            let weights = rows(format, 1 + outputs * plane, &mut next);
            // The last input goes with the first weights.
            let terms: Vec<Term> = (0..count)
                .map(|i| Term {
                    input: inputs[(count - 1 - i) * (position + CHUNK)..].as_ptr(),
                    weights: i * LANES * size_of::<Wide>(),
                })
                .collect();
            let groups = vec![4; count];
            let of = |engine: Engine| {
                let (mut sums, weights) = (untouched(), weights[1..].as_ptr());
                let product = Product { terms: &terms, groups: &groups, position, weights, outputs, plane };
                // SAFETY: each term has 32 rows of inputs from `position` on, and 16 of weights in each
                // plane.
                engine.ready(|| unsafe { engine.multiply(format, product, &mut sums) });
                values(&sums)
            };
            check(
                &of(engine),
                &of(Engine::PORTABLE),
                &format!("{count} terms, {outputs} planes, at {position}"),
            );
        }
    }

    #[test]
    fn products_of_8_bits_are_the_portable_ones() {
        let Some(engine) = engine() else { return };
        products(engine, INT8, |got, want, what| assert!(bits(got) == bits(want), "{what}"));
    }

    #[test]
    fn products_of_bfloat16_are_near_the_portable_ones() {
        let Some(engine) = engine() else { return };
        products(engine, Format::Bf16, assert_close);
    }

    #[test]
    fn correlations_are_near_the_portable_ones() {
        let Some(engine) = engine() else { return };
        for (steps, outputs) in [(1, 1), (1, 2), (5, 1), (5, 2)] {
            let mut next = random(steps as u64);
            // Channels begin at any position, and rows are longer than what is summed over.
            let row = steps * CHUNK + 6;
            let channels: Vec<bf16> = (0..3 + WIDE * row).map(|_| bf16::from_f32(real(next()))).collect();
            let plane = steps * CHUNK / 2 + 2;
            let pairs = rows(Format::Bf16, outputs * plane, &mut next);
            let of = |engine: Engine| {
                let mut sums = untouched();
                let correlation = Correlation {
                    steps,
                    channels: channels[3..].as_ptr(),
                    stride: row * size_of::<bf16>(),
                    pairs: pairs.as_ptr(),
                    outputs,
                    plane,
                };
                // SAFETY: there are 32 rows of channels, and as many pairs in each plane.
                engine.ready(|| unsafe { engine.correlate(correlation, &mut sums) });
                values(&sums)
            };
            let what = format!("{steps} steps, {outputs} planes");
            assert_close(&of(engine), &of(Engine::PORTABLE), &what);
        }
    }

    /// Also on threads other than this one, each of which has tiles of its own.
    #[test]
    fn layers_in_8_bits_are_the_portable_ones() {
        let Some(engine) = engine() else { return };
        let mut next = random(1);
        for geometry in [Geometry::Same(1), Geometry::Same(3), Geometry::Transposed] {
            // Planes of more and of fewer channels than a row of a tile has, and three planes of outputs.
            let (shape, channels, outputs) = (Shape::new(2, 0, 5, 37), [70, 20], 40);
            // Only where an output has one sum may zero be a step other than the first.
            let zero = if geometry == Geometry::Transposed { 0 } else { 100 };
            let steps = [Steps { step: 0.5, zero }, Steps { step: 0.125, zero: 0 }];
            let sources = [0, 1].map(|i| (channels[i], steps[i]));
            let operands = sources.map(|(channels, steps)| {
                let shape = shape.with_channels(channels);
                let values: Vec<f32> =
                    (0..2 * channels * 5 * 37).map(|_| real(next()) * 200.0 * steps.step).collect();
                let mut blocks = vec![Block::default(); shape.blocks()];
                to_blocked(&values, 1, ViewMut::new(shape, &mut blocks));
                Operand::quantize(View::new(shape, &blocks), steps)
            });
            let weights: Vec<f32> = (0..90 * outputs * geometry.taps()).map(|_| real(next())).collect();
            let (h, w) = geometry.output(shape.h, shape.w);
            let shape = shape.with_channels(outputs).with_size(h, w);
            let bias: Vec<Block> =
                (0..shape.planes()).map(|_| Block(std::array::from_fn(|_| real(next())))).collect();
            let of = |engine: Engine| {
                let weights = Weights::quantize(engine, &weights, &sources, outputs, geometry);
                let mut out = vec![Block::default(); shape.blocks()];
                let to = Output::F32(ViewMut::new(shape, &mut out));
                convolve(engine, &operands.each_ref(), &weights, &bias, Epilogue::default(), to);
                out.iter().flat_map(|block| block.0.map(f32::to_bits)).collect::<Vec<_>>()
            };
            assert!(of(engine) == of(Engine::PORTABLE), "{geometry:?}");
        }
    }

    /// The emulation hides no other instruction that the processor lacks.
    #[test]
    fn other_unknown_instructions_end_the_process() {
        emulation::install();
        // SAFETY: the new process, which has this thread alone, runs a single instruction.
        let (child, status) = unsafe {
            let child = libc::fork();
            if child == 0 {
                asm!("ud2", options(noreturn));
            }
            let mut status = 0;
            (libc::waitpid(child, &raw mut status, 0), status)
        };
        assert!(child > 0 && libc::WIFSIGNALED(status) && libc::WTERMSIG(status) == libc::SIGILL, "{status}");
    }
}
