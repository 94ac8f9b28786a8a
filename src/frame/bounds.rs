//! Whether a stored block may be handed to its decoder. Decoders set memory aside for the size that a block
//! claims to unpack to. A claim of more than its bytes can hold is refused, or a damaged counter could take
//! all memory and end the process.
//!
//! In: a block's bytes and the size of its pixels. Out: why it must not be decoded, if so.

use exr::{compression::Compression, math::Vec2, meta::header::Header};

/// The most bytes that deflate packs into one: 258 bytes take two bits.
const DEFLATE: usize = 1032;
/// More bytes than any compression except DWA packs into one. PXR24 leaves out every fourth byte before
/// deflate, and PIZ's runs pack 453.
const MOST_PACKED: usize = 2 * DEFLATE;
/// The most bytes that two bytes of DWA's run-length code unpack to.
const LONGEST_RUN: usize = 128;
/// Values in a block of DWA's cosine transform.
const TRANSFORMED: usize = 64;

/// Refuses a block of `size` pixels that claims more than its bytes can hold.
///
/// # Errors
/// What the block claims.
pub fn check(header: &Header, stored: &[u8], size: Vec2<usize>) -> Result<(), String> {
    let raw = size.area() * header.channels.bytes_per_pixel;
    // Stored as it is, since no kind of compression made it smaller.
    if stored.len() == raw {
        return Ok(());
    }
    match header.compression {
        Compression::Uncompressed => Err(format!("a block of {raw} bytes has {}", stored.len())),
        Compression::DWAA(_) | Compression::DWAB(_) => check_dwa(header, stored, size),
        _ if raw > MOST_PACKED * stored.len() => {
            Err(format!("a block of {} bytes claims to unpack to {raw}", stored.len()))
        }
        _ => Ok(()),
    }
}

/// Checks the counters at the start of a DWA block (`DataSizesSingle` in OpenEXR's internal_dwa_compressor.h)
/// against each other, and against the pixels of the block.
fn check_dwa(header: &Header, stored: &[u8], size: Vec2<usize>) -> Result<(), String> {
    const COUNTERS: usize = 11;
    let read = |bytes: &[u8; 8]| usize::try_from(u64::from_le_bytes(*bytes)).unwrap_or(usize::MAX);
    let counters: Vec<usize> = stored.as_chunks::<8>().0.iter().take(COUNTERS).map(read).collect();
    let [
        _version,
        unknown,
        unknown_packed,
        ac_packed,
        dc_packed,
        rle_packed,
        tokens,
        rle,
        ac,
        dc,
        _ac_compression,
    ] = counters[..]
    else {
        return Err("a DWA block ends within its counters".into());
    };
    let raw = size.area() * header.channels.bytes_per_pixel;
    let transforms = size.width().div_ceil(8) * size.height().div_ceil(8) * header.channels.list.len();
    let packed = |bytes: usize| bytes.saturating_mul(DEFLATE);
    let limits = [
        (
            "stored bytes",
            [unknown_packed, ac_packed, dc_packed, rle_packed]
                .iter()
                .fold(0, |sum: usize, n| sum.saturating_add(*n)),
            stored.len(),
        ),
        ("bytes", unknown, raw.min(packed(unknown_packed))),
        ("runs", tokens, (2 * raw).min(packed(rle_packed))),
        ("bytes of runs", rle, raw.min(tokens.saturating_mul(LONGEST_RUN))),
        ("AC values", ac, TRANSFORMED * transforms),
        ("DC values", dc, transforms.min(packed(dc_packed) / 2)),
    ];
    if let Some((what, claimed, most)) = limits.into_iter().find(|(_, claimed, most)| claimed > most) {
        return Err(format!("a DWA block claims {claimed} {what}, but can hold {most}"));
    }
    // What the block holds must be enough for its pixels.
    let held = unknown + rle + dc * TRANSFORMED * size_of::<f32>();
    if held < raw { Err(format!("a DWA block holds {held} of {raw} bytes")) } else { Ok(()) }
}
