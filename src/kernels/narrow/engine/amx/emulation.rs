//! The instructions of AMX that the engine uses, for tests on processors that have none. Such a processor
//! stops at each of them and the system sends the signal SIGILL; its handler here does what the instruction
//! would have done, and lets the thread go on behind it. So the engine's machine code is tested as it is.
//!
//! Encodings and operations are those of Intel's manual ("Software Developer's Manual", volume 2). Any other
//! unknown instruction ends the process, as it does without the handler. A handler may interrupt anything, so
//! it neither allocates nor waits.

use std::{cell::RefCell, mem, ptr, sync::Once};

use half::bf16;

use super::ROW;

const ROWS: usize = 16;
type Tile = [[u8; ROW]; ROWS];
type Tiles = [Tile; 8];

thread_local! {
    /// This thread's tiles while they are configured. They need no set-up, so that the handler may use them.
    static TILES: RefCell<Option<Tiles>> = const { RefCell::new(None) };
}

/// From now on this process emulates the instructions.
pub fn install() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let handler: extern "C" fn(_, _, _) = handle;
        // SAFETY: a zeroed action is one without flags that blocks no signal; the handler takes what
        // SA_SIGINFO passes.
        let status = unsafe {
            let mut action: libc::sigaction = mem::zeroed();
            action.sa_sigaction = handler as libc::sighandler_t;
            action.sa_flags = libc::SA_SIGINFO;
            libc::sigaction(libc::SIGILL, &raw const action, ptr::null_mut())
        };
        assert_eq!(status, 0, "SIGILL can be handled");
    });
}

/// Registers of the thread that was stopped, as the system stores them.
type Registers = [libc::greg_t];

extern "C" fn handle(_: libc::c_int, _: *mut libc::siginfo_t, context: *mut libc::c_void) {
    // SAFETY: the system passes the state of the thread, which nothing else uses until the handler returns.
    let registers = unsafe { &mut (*context.cast::<libc::ucontext_t>()).uc_mcontext.gregs };
    // SAFETY: the thread stopped at an instruction that the processor does not know.
    match TILES.with_borrow_mut(|tiles| unsafe { execute(registers, tiles) }) {
        Some(length) => registers[libc::REG_RIP as usize] += length as libc::greg_t,
        // SAFETY: the call may be made from a handler. The thread then meets the instruction once more, which
        // ends the process.
        None => unsafe {
            libc::signal(libc::SIGILL, libc::SIG_DFL);
        },
    }
}

/// Does what the instruction says at which a thread stopped, and returns its length, or `None` if it is none
/// of those known here.
///
/// # Safety
/// The registers are those of a thread that stopped there, and what the instruction reads and writes is
/// valid.
unsafe fn execute(registers: &Registers, tiles: &mut Option<Tiles>) -> Option<usize> {
    let code = address(registers[libc::REG_RIP as usize] as usize);
    // SAFETY: the bytes are those of an instruction, and are only read as far as it is one of those known
    // here.
    let byte = |i: usize| unsafe { *code.add(i) };
    // A VEX prefix of three bytes. The second names the map of opcodes, 0F38, and has a bit that is clear
    // only for register numbers above 7. W and L in the third are zero.
    if byte(0) != 0xc4 || byte(1) & 0x9f != 0x82 || byte(2) & 0x84 != 0 {
        return None;
    }
    let (vex, opcode, operands) = (byte(2), byte(3), byte(4));
    // The third operand's number is stored inverted; without a third operand it is zero.
    let third = usize::from(!vex >> 3 & 15);
    let (first, second) = (usize::from(operands >> 3 & 7), usize::from(operands & 7));
    let in_memory = operands < 0xc0;
    let after_operands = 5;
    match (opcode, vex & 3, in_memory) {
        // ldtilecfg: only eight tiles of full size, as the engine wants them.
        (0x49, 0, true) if first == 0 && third == 0 => {
            // SAFETY: the caller's promise.
            let Memory { start, step, end } = unsafe { memory(registers, code)? };
            // SAFETY: the instruction reads as many bytes.
            let config = unsafe { address(start.wrapping_add(step)).cast::<[u8; 64]>().read() };
            let expected: [u8; 64] = std::array::from_fn(|i| match i {
                0 => 1,
                16..32 if i % 2 == 0 => ROW as u8,
                48..56 => ROWS as u8,
                _ => 0,
            });
            if config != expected {
                return None;
            }
            *tiles = Some([[[0; ROW]; ROWS]; 8]);
            Some(end)
        }
        // tilerelease
        (0x49, 0, false) if operands == 0xc0 && third == 0 => {
            *tiles = None;
            Some(after_operands)
        }
        // tilezero
        (0x49, 3, false) if second == 0 && third == 0 => {
            tiles.as_mut()?[first] = [[0; ROW]; ROWS];
            Some(after_operands)
        }
        // tileloadd and tilestored, whose address always has an index
        (0x4b, 3 | 2, true) if second == 4 && third == 0 => {
            // SAFETY: the caller's promise.
            let Memory { start, step, end } = unsafe { memory(registers, code)? };
            for (i, row) in tiles.as_mut()?[first].iter_mut().enumerate() {
                let place = address(start.wrapping_add(i.wrapping_mul(step))).cast::<[u8; ROW]>();
                // SAFETY: the instruction reads or writes the row there.
                unsafe {
                    if vex & 3 == 3 {
                        *row = place.read();
                    } else {
                        place.write(*row);
                    }
                }
            }
            Some(end)
        }
        // tdpbf16ps
        (0x5c, 2, false) => {
            add_products(tiles.as_mut()?, first, second, third, |sum, a, b| {
                let real =
                    |word: [u8; 4], i: usize| bf16::from_le_bytes([word[2 * i], word[2 * i + 1]]).to_f32();
                let sum = f32::from_le_bytes(sum) + real(a, 0) * real(b, 0);
                (sum + real(a, 1) * real(b, 1)).to_le_bytes()
            })?;
            Some(after_operands)
        }
        // tdpbusd: the second operand has no sign, the third has one.
        (0x5e, 1, false) => {
            add_products(tiles.as_mut()?, first, second, third, |sum, a, b| {
                let product = |i: usize| i32::from(a[i]) * i32::from(b[i].cast_signed());
                let products: i32 = (0..4).map(product).sum();
                i32::from_le_bytes(sum).wrapping_add(products).to_le_bytes()
            })?;
            Some(after_operands)
        }
        _ => None,
    }
}

/// `first[m][n] = add(first[m][n], second[m][k], third[k][n])` for every word `k` of a row, one after
/// another. The processor refuses operands that are not three tiles.
fn add_products(
    tiles: &mut Tiles,
    first: usize,
    second: usize,
    third: usize,
    add: impl Fn([u8; 4], [u8; 4], [u8; 4]) -> [u8; 4],
) -> Option<()> {
    if first == second || first == third || second == third || third >= tiles.len() {
        return None;
    }
    let (a, b) = (tiles[second], tiles[third]);
    for (sums, a) in tiles[first].iter_mut().zip(&a) {
        for (a, b) in a.as_chunks::<4>().0.iter().zip(&b) {
            for (sum, b) in sums.as_chunks_mut::<4>().0.iter_mut().zip(b.as_chunks::<4>().0) {
                *sum = add(*sum, *a, *b);
            }
        }
    }
    Some(())
}

/// An operand in memory.
struct Memory {
    /// The base and the displacement.
    start: usize,
    /// The index times its scale: how far rows of a tile lie apart.
    step: usize,
    /// Length of the instruction.
    end: usize,
}

/// The operand in memory of the instruction at `code`.
///
/// # Safety
/// There is an instruction with a VEX prefix of three bytes and such an operand.
unsafe fn memory(registers: &Registers, code: *const u8) -> Option<Memory> {
    // SAFETY: the caller's promise; the bytes are read only as far as those before say that there are more.
    let byte = |i: usize| unsafe { *code.add(i) };
    // Numbers above 7 have their highest bit in the prefix, inverted.
    let high = |bit: u8| if byte(1) & bit == 0 { 8 } else { 0 };
    let (mode, second) = (byte(4) >> 6, byte(4) & 7);
    let (mut base, mut step, mut end) = (second, 0, 5);
    if second == 4 {
        let (scale, index) = (byte(5) >> 6, (byte(5) >> 3 & 7) | high(0x40));
        // The stack pointer's number stands for no index.
        if index != 4 {
            step = register(registers, index) << scale;
        }
        (base, end) = (byte(5) & 7, 6);
    }
    let displacement = match mode {
        // Such a base would mean an address without a base, or one that counts from the instruction.
        0 if base == 5 => return None,
        0 => 0,
        1 => isize::from(byte(end).cast_signed()),
        _ => i32::from_le_bytes([0, 1, 2, 3].map(|i| byte(end + i))) as isize,
    };
    end += [0, 1, 4][usize::from(mode)];
    let start = register(registers, base | high(0x20)).wrapping_add_signed(displacement);
    Some(Memory { start, step, end })
}

/// The general register that has this number in instructions.
fn register(registers: &Registers, number: u8) -> usize {
    const PLACES: [libc::c_int; 16] = [
        libc::REG_RAX,
        libc::REG_RCX,
        libc::REG_RDX,
        libc::REG_RBX,
        libc::REG_RSP,
        libc::REG_RBP,
        libc::REG_RSI,
        libc::REG_RDI,
        libc::REG_R8,
        libc::REG_R9,
        libc::REG_R10,
        libc::REG_R11,
        libc::REG_R12,
        libc::REG_R13,
        libc::REG_R14,
        libc::REG_R15,
    ];
    registers[PLACES[usize::from(number)] as usize] as usize
}

/// Memory at an address that a register holds.
fn address(of: usize) -> *mut u8 {
    ptr::with_exposed_provenance_mut(of)
}
