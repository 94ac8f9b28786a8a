//! AMX-BF16: 16x16 tiles, 8192 multiply-accumulates an instruction. Products of 8 bits and conversions are
//! those of the AVX-512 engine.

use std::{arch::asm, sync::OnceLock};

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

    fn ready<R>(self, work: impl FnOnce() -> R) -> R {
        let _tiles = Tiles::configure();
        work()
    }

    unsafe fn multiply_int8(self, product: Product, sums: &mut Sums) {
        // SAFETY: the caller's promise.
        unsafe { self.0.multiply_int8(product, sums) }
    }

    unsafe fn multiply_bf16(self, product: Product, sums: &mut Sums) {
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
        const { assert!(TILE == 1024 && size_of::<Sums>() == 4 * TILE && size_of::<Term>() == 16) };
        const { assert!(size_of::<Wide>() == ROW && WIDE == 32) };
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

/// Whether the processor has AMX-BF16 and the system's kernel lets this process use it.
fn permitted() -> bool {
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
