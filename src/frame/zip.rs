//! ZIP blocks, compressed at twice the speed of the `exr` crate to the same size: writing must not take
//! the processor from the model while a batch runs.
//!
//! In: a block of raw pixels. Out: its chunk, as OpenEXR's ImfZip lays it out: even bytes before odd
//! ones, differences of neighbours, deflate. Other compressions go to the `exr` crate.

use exr::{
    block::{
        UncompressedBlock,
        chunk::{Chunk, CompressedBlock, CompressedScanLineBlock, CompressedTileBlock, TileCoordinates},
    },
    compression::Compression,
    meta::{BlockDescription, header::Header},
};
use flate2::{Compress, FlushCompress};

/// On renders as small as miniz's level 4, which the `exr` crate uses, in half the time.
const LEVEL: u32 = 2;

/// The chunk of a block; `headers` are those of the file.
pub fn compress(block: UncompressedBlock, headers: &[Header]) -> exr::error::Result<Chunk> {
    let header = &headers[block.index.layer];
    let is_zip = matches!(header.compression, Compression::ZIP1 | Compression::ZIP16);
    // Files are little-endian; elsewhere the `exr` crate swaps the bytes first.
    if !is_zip || cfg!(target_endian = "big") {
        return block.compress_to_chunk(headers);
    }
    let UncompressedBlock { index, data } = block;
    let compressed_pixels_le = deflate(&data).unwrap_or(data);
    let compressed_block = match header.blocks {
        BlockDescription::ScanLines => {
            let y =
                i32::try_from(index.pixel_position.y()).expect("a row's number fits: headers hold an i32");
            let y_coordinate = y + header.own_attributes.layer_position.y();
            CompressedBlock::ScanLine(CompressedScanLineBlock { y_coordinate, compressed_pixels_le })
        }
        BlockDescription::Tiles(_) => {
            let tile_index = index.pixel_position / header.max_block_pixel_size();
            let coordinates = TileCoordinates { tile_index, level_index: index.level };
            CompressedBlock::Tile(CompressedTileBlock { coordinates, compressed_pixels_le })
        }
    };
    Ok(Chunk { layer_index: index.layer, compressed_block })
}

/// Compressed bytes; none where they are not fewer: such a block is stored as it is.
fn deflate(raw: &[u8]) -> Option<Vec<u8>> {
    let (pairs, last) = raw.as_chunks::<2>();
    let mut parted: Vec<u8> = pairs.iter().map(|pair| pair[0]).collect();
    parted.extend(last);
    parted.extend(pairs.iter().map(|pair| pair[1]));
    let mut differences = parted.clone();
    let neighbours = parted.iter().zip(parted.iter().skip(1));
    for (difference, (before, byte)) in differences.iter_mut().skip(1).zip(neighbours) {
        *difference = byte.wrapping_sub(*before).wrapping_add(128);
    }
    let mut compressed = Vec::with_capacity(raw.len());
    let status = Compress::new(flate2::Compression::new(LEVEL), true)
        .compress_vec(&differences, &mut compressed, FlushCompress::Finish)
        .ok()?;
    (status == flate2::Status::StreamEnd && compressed.len() < raw.len()).then_some(compressed)
}

#[cfg(test)]
mod tests {
    use exr::{
        block::BlockIndex,
        math::{RoundingMode, Vec2},
        meta::{
            MetaData, Requirements,
            attribute::{ChannelDescription, LevelMode, LineOrder, SampleType, Text, TileDescription},
        },
    };

    use super::*;

    fn meta(compression: Compression, blocks: BlockDescription) -> MetaData {
        let channel = |name: &str, kind| ChannelDescription::new(Text::from(name), kind, false);
        let channels = vec![channel("A", SampleType::F16), channel("Z", SampleType::F32)];
        let header = Header::new(Text::from("part"), (37, 48), channels.into()).with_encoding(
            compression,
            blocks,
            LineOrder::Increasing,
        );
        let requirements = Requirements {
            file_format_version: 2,
            is_single_layer_and_tiled: false,
            has_long_names: false,
            has_deep_data: false,
            has_multiple_layers: false,
        };
        MetaData { requirements, headers: vec![header].into() }
    }

    /// The second block of the part from the top.
    fn block(data: Vec<u8>, height: usize) -> UncompressedBlock {
        let index = BlockIndex {
            layer: 0,
            pixel_position: Vec2(0, height),
            pixel_size: Vec2(37, height),
            level: Vec2(0, 0),
        };
        UncompressedBlock { index, data }
    }

    #[test]
    fn the_exr_crate_reads_back_every_byte() {
        let mut state = 1u32;
        let mut noise = move || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        };
        for (compression, rows) in [(Compression::ZIP1, 1), (Compression::ZIP16, 16)] {
            let meta = meta(compression, BlockDescription::ScanLines);
            let len = 37 * rows * 6;
            let smooth = (0..len).map(|i| (i / 40) as u8).collect();
            for (data, shrinks) in [(smooth, true), ((0..len).map(|_| noise()).collect::<Vec<u8>>(), false)] {
                let chunk = compress(block(data.clone(), rows), &meta.headers).unwrap();
                let CompressedBlock::ScanLine(stored) = &chunk.compressed_block else {
                    panic!("a scan-line part has scan-line blocks")
                };
                assert_eq!(stored.compressed_pixels_le.len() < len, shrinks, "{compression:?}");
                let read = UncompressedBlock::decompress_chunk(chunk, &meta, true).unwrap();
                assert_eq!((read.data, read.index.pixel_size), (data, Vec2(37, rows)));
            }
        }
    }

    #[test]
    fn place_and_layout_are_those_of_the_exr_crate() {
        let tiles = TileDescription {
            tile_size: Vec2(37, 16),
            level_mode: LevelMode::Singular,
            rounding_mode: RoundingMode::Down,
        };
        let data: Vec<u8> = (0..37 * 16 * 6).map(|i| (i * i / 991) as u8).collect();
        for blocks in [BlockDescription::ScanLines, BlockDescription::Tiles(tiles)] {
            let meta = meta(Compression::ZIP16, blocks);
            let [ours, theirs] = [
                compress(block(data.clone(), 16), &meta.headers).unwrap(),
                block(data.clone(), 16).compress_to_chunk(&meta.headers).unwrap(),
            ]
            .map(|chunk| {
                let (place, bytes) = match chunk.compressed_block {
                    CompressedBlock::ScanLine(b) => (format!("{}", b.y_coordinate), b.compressed_pixels_le),
                    CompressedBlock::Tile(b) => (format!("{:?}", b.coordinates), b.compressed_pixels_le),
                    _ => panic!("the part is flat"),
                };
                // Two deflate streams, but what they unpack to is parted and differenced alike.
                let mut unpacked = Vec::new();
                let mut reader = flate2::read::ZlibDecoder::new(&bytes[..]);
                std::io::Read::read_to_end(&mut reader, &mut unpacked).unwrap();
                (chunk.layer_index, place, unpacked)
            });
            assert_eq!(ours, theirs);
        }
    }
}
