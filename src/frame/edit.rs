//! Adding and replacing layers. Parts left alone keep their compressed chunks; the part that takes
//! channels is recompressed from its raw bytes, so kept channels never pass through f32.
//!
//! In: full-resolution f32 planes. Out: the frame, ready to be written.

use std::{collections::BTreeSet, fmt};

use exr::{
    block::{BlockIndex, UncompressedBlock, chunk::TileCoordinates},
    compression::Compression,
    math::Vec2,
    meta::{
        BlockDescription,
        attribute::{ChannelDescription, ChannelList, LevelMode, LineOrder, SampleType, Text},
        compute_level_size,
        header::Header,
    },
};
use half::{f16, vec::HalfFloatVecExt};
use rayon::prelude::*;

use super::{
    Frame, SampleKind, Stored, StoredChunk,
    bytes::Bytes,
    chroma,
    decode::row_bytes,
    header::{Attributes, write_tiles},
    read::LONGEST_NAME,
    zip,
};
use crate::{Error, Result};

/// What no layer's name may hold: names end at a zero, and marks list them one a line.
pub const UNSTORABLE: [char; 2] = ['\0', '\n'];

/// Largest finite half.
pub const HALF_MAX: f32 = f16::MAX.to_f32_const();

/// Attribute that names the layers of its part that demc made, one a line. A layer that it does not name is
/// never replaced by one of the same name.
const MARK: &str = "demc";
/// Attribute that tells how far off results are expected to be: a line for each, its expected RelMSE and its layer's
/// name (with its stereo view, where it has one).
const EXPECTED_ERROR: &str = "demcExpectedError";
// What is noted of each layer that demc made, in pairs of lines: the layer's name, and below it what is noted.
/// Attribute with the frames by number that layers were made without.
const LACKED: &str = "demcLacked";
/// Attribute with how many frames before and after layers were made with.
const REACH: &str = "demcNeighbours";
/// Attribute with how layers were made.
const METHOD: &str = "demcMethod";
/// Attributes that another part of the same picture does not take over; nor does it take those of
/// cryptomattes.
const OWN: [&str; 9] =
    [MARK, METHOD, EXPECTED_ERROR, LACKED, REACH, "name", "preview", "chunkCount", "idManifest"];
/// The name that a part without one gets in a file of several parts, where each must have a name.
const BEAUTY: &str = "rgba";
/// How the names of a cryptomatte's attributes begin.
const CRYPTOMATTE: &[u8] = b"cryptomatte/";

/// A channel to store: values of the whole data window, row-major.
#[derive(Clone, Copy, Debug)]
pub struct NewChannel<'a> {
    /// Component name: `R`, `G`, `B`, `A` ...
    pub component: &'a str,
    /// Number type to store. Halves hold at most 65504: larger values are stored as that.
    pub kind: SampleKind,
    /// `height * width` values.
    pub values: &'a [f32],
}

/// A part had to change its compression, because compressing its other channels a second time with
/// the lossy kind it had would have lost more. They are now stored as ZIP, exactly as they decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Recoded {
    /// The lossy compression it had.
    pub from: &'static str,
}

impl fmt::Display for Recoded {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "stored as ZIP instead of {}, which loses a little each time it is written",
            self.from.to_uppercase()
        )
    }
}

/// Channels by full name, as it is stored, bound for one part.
type Named<'a> = Vec<(Vec<u8>, NewChannel<'a>)>;

/// A layer's name with the stereo view, where there is one.
fn with_view(name: &str, view: Option<&str>) -> String {
    view.map_or_else(|| name.into(), |view| format!("{name}.{view}"))
}

/// What [`Frame::set_expected_error`] noted in a part.
fn expected_errors(attributes: &Attributes) -> Vec<(String, f64)> {
    let text = attributes.text(EXPECTED_ERROR).unwrap_or_default();
    let read = |line: &str| {
        let (error, name) = line.split_once(' ')?;
        Some((name.to_owned(), error.parse().ok()?))
    };
    text.lines().filter_map(read).collect()
}

/// What [`Frame::note`] noted of the layers of a part.
fn noted(attributes: &Attributes, attribute: &str) -> Vec<(String, String)> {
    let text = attributes.text(attribute).unwrap_or_default();
    let lines: Vec<&str> = text.lines().collect();
    lines.chunks_exact(2).map(|pair| (pair[0].into(), pair[1].into())).collect()
}

impl Frame {
    /// Adds the layer `name` (such as `ViewLayer.Denoised`) with the data window of the part `beside`,
    /// or replaces the channels of that name. A multi-part file gets a new part after the others, a
    /// single-part file new channels. A stereo `view` is named as Blender does: in the part's name
    /// (`ViewLayer.Denoised-left`), or in the channels' (`ViewLayer.Denoised.left.R`).
    ///
    /// # Errors
    /// The part cannot be decoded or encoded, or a name cannot be stored.
    ///
    /// # Panics
    /// If there are no channels, two of one name, or one that has not as many values as the part has pixels.
    pub fn set_layer(
        &mut self,
        beside: usize,
        name: &str,
        view: Option<&str>,
        channels: &[NewChannel<'_>],
    ) -> Result<Option<Recoded>> {
        let area = self.layout(beside)?.layer_size.area();
        assert!(!channels.is_empty(), "a layer has channels");
        for (i, channel) in channels.iter().enumerate() {
            assert_eq!(channel.values.len(), area, "one value for each pixel");
            let is_twice = channels[..i].iter().any(|other| other.component == channel.component);
            assert!(!is_twice, "two channels '{}'", channel.component);
        }
        let names = channels.iter().map(|channel| channel.component).chain([name]).chain(view);
        if let Some(name) = names.into_iter().find(|name| name.contains(UNSTORABLE)) {
            return Err(Error::invalid(&self.path, format!("a layer or channel cannot be called {name:?}")));
        }
        let own_part = self.is_part_per_pass(beside);
        let (part_name, prefix) = match view {
            None => (name.to_owned(), name.to_owned()),
            Some(view) if own_part => {
                // A part that says nothing of its view has it in the names of its channels.
                let is_of_part = self.parts[beside].view.is_some();
                let prefix = if is_of_part { name.to_owned() } else { format!("{name}.{view}") };
                (format!("{name}-{view}"), prefix)
            }
            // Channels of a file that is one view have no view in their names.
            Some(view) if self.parts[beside].view.as_deref() == Some(view) => {
                (name.to_owned(), name.to_owned())
            }
            Some(view) => (name.to_owned(), format!("{name}.{view}")),
        };
        let named = channels.iter().map(|c| (format!("{prefix}.{}", c.component).into_bytes(), *c));
        let named: Named<'_> = named.collect();
        if let Some((long, _)) = named.iter().find(|(name, _)| name.len() > LONGEST_NAME) {
            let why = format!(
                "no channel can be called '{}', which is longer than {LONGEST_NAME} bytes; choose a shorter --layer",
                String::from_utf8_lossy(long)
            );
            return Err(Error::invalid(&self.path, why));
        }
        let beside_view = &self.parts[beside].view;
        let holder = self.parts.iter().position(|p| {
            p.view == *beside_view && p.channels.iter().any(|c| c.name.as_bytes() == named[0].0)
        });
        if let Some(holder) = holder
            && self.parts[holder].data_window != self.parts[beside].data_window
        {
            let why = format!(
                "holds the result '{name}', cropped since, beside a picture of another size; take it out of the file, or \
                 choose another name (--layer NAME)"
            );
            return Err(Error::invalid(&self.path, why));
        }
        // Of a layer that demc made before, nothing is left that the new one has not.
        let outdated = self.is_own_layer(name).then(|| format!("{prefix}."));
        let (part, recoded) = match holder {
            Some(part) => (part, self.set_channels(part, &named, outdated.as_deref())?),
            None if own_part => {
                self.add_part(beside, &part_name, &named)?;
                (self.parts.len() - 1, None)
            }
            None => (beside, self.set_channels(beside, &named, None)?),
        };
        self.mark(part, name);
        Ok(recoded)
    }

    /// Notes the expected RelMSE of the layer `name`, which demc made, in a stereo view where it has several; or forgets
    /// that of an earlier result, where none is known.
    ///
    /// # Panics
    /// If demc made no such layer.
    pub fn set_expected_error(&mut self, name: &str, view: Option<&str>, error: Option<f64>) {
        let attributes = self.attributes_beside(name);
        let mut errors = expected_errors(attributes);
        if errors.is_empty() && error.is_none() {
            return;
        }
        let result = with_view(name, view);
        errors.retain(|(other, _)| *other != result);
        errors.extend(error.map(|error| (result, error)));
        let lines: Vec<String> = errors.iter().map(|(name, error)| format!("{error:.3e} {name}")).collect();
        attributes.set_text(EXPECTED_ERROR, &lines.join("\n"));
    }

    /// The results that note an expected RelMSE, by layer and stereo view, each with that error.
    pub fn expected_errors(&self) -> Vec<(String, f64)> {
        self.stored.iter().flat_map(|stored| expected_errors(&stored.attributes)).collect()
    }

    /// The expected RelMSE of the layer `name`, in a stereo view where it has several; none where it is not noted.
    pub fn expected_error(&self, name: &str, view: Option<&str>) -> Option<f64> {
        let result = with_view(name, view);
        self.expected_errors().into_iter().find(|(other, _)| *other == result).map(|(_, error)| error)
    }

    /// Notes how the layer `name` was made, which demc made: a text of one line.
    ///
    /// # Panics
    /// If demc made no such layer.
    pub fn set_method(&mut self, name: &str, method: &str) {
        self.note(METHOD, name, Some(&method.replace(UNSTORABLE, " ")));
    }

    /// The layers that demc made, each with how it did so, where that is noted.
    pub fn methods(&self) -> Vec<(String, String)> {
        self.stored.iter().flat_map(|stored| noted(&stored.attributes, METHOD)).collect()
    }

    /// Notes the frames by number that the layer `name`, which demc made, was made without though they belong to its
    /// window; or forgets those of an earlier result.
    ///
    /// # Panics
    /// If demc made no such layer.
    pub fn set_lacked(&mut self, name: &str, frames: &BTreeSet<i64>) {
        let listed: Vec<String> = frames.iter().map(i64::to_string).collect();
        self.note(LACKED, name, (!frames.is_empty()).then(|| listed.join(" ")).as_deref());
    }

    /// Notes how many frames before and after the layer `name`, which demc made, was made with, as far as they are
    /// there; or forgets what is noted of an earlier result.
    ///
    /// # Panics
    /// If demc made no such layer.
    pub fn set_reach(&mut self, name: &str, reach: usize) {
        self.note(REACH, name, (reach > 0).then(|| reach.to_string()).as_deref());
    }

    /// How many frames before and after the layer `name` was made with.
    pub fn reach(&self, name: &str) -> usize {
        self.noted(REACH, name).and_then(|reach| reach.parse().ok()).unwrap_or(0)
    }

    /// The frames by number that the layer `name` was made without.
    pub fn lacked(&self, name: &str) -> BTreeSet<i64> {
        let list = self.noted(LACKED, name).unwrap_or_default();
        list.split(' ').filter_map(|frame| frame.parse().ok()).collect()
    }

    /// How the layer `name` was made, where that is noted.
    pub fn method(&self, name: &str) -> Option<String> {
        self.noted(METHOD, name)
    }

    /// Notes something of the layer `name`, which demc made, or forgets what is noted of an earlier one.
    fn note(&mut self, attribute: &str, name: &str, what: Option<&str>) {
        let attributes = self.attributes_beside(name);
        let mut of_layers = noted(attributes, attribute);
        if of_layers.is_empty() && what.is_none() {
            return;
        }
        of_layers.retain(|(layer, _)| layer != name);
        of_layers.extend(what.map(|what| (name.into(), what.into())));
        let lines: Vec<String> = of_layers.iter().map(|(name, what)| format!("{name}\n{what}")).collect();
        attributes.set_text(attribute, &lines.join("\n"));
    }

    /// What is noted of the layer `name`.
    fn noted(&self, attribute: &str, name: &str) -> Option<String> {
        let mut of_layers = self.stored.iter().flat_map(|stored| noted(&stored.attributes, attribute));
        of_layers.find(|(layer, _)| layer == name).map(|(_, what)| what)
    }

    /// The attributes of the part that holds a layer which demc made.
    fn attributes_beside(&mut self, name: &str) -> &mut Attributes {
        let is_holder = |part: &usize| self.marked(*part).iter().any(|layer| layer == name);
        let part = (0..self.parts.len()).find(is_holder).expect("the layer was made before");
        &mut self.stored[part].attributes
    }

    /// Lists a layer among those that demc made.
    fn mark(&mut self, part: usize, name: &str) {
        let mut marked = self.marked(part);
        if !marked.iter().any(|layer| layer == name) {
            marked.push(name.into());
            self.stored[part].attributes.set_text(MARK, &marked.join("\n"));
        }
    }

    /// Whether demc made the layer of that name: [`Frame::set_layer`] added it, or [`Frame::replace`]
    /// overwrote it.
    pub fn is_own_layer(&self, name: &str) -> bool {
        (0..self.parts.len()).any(|part| self.marked(part).iter().any(|layer| layer == name))
    }

    /// Whether demc made any of its layers.
    pub fn is_result(&self) -> bool {
        (0..self.parts.len()).any(|part| !self.marked(part).is_empty())
    }

    /// Whether there is a layer of that name, in any letter case, that demc did not make.
    pub fn has_foreign_layer(&self, name: &str) -> bool {
        let is_named = |part: &super::Part, channel: &str| {
            let layer = match channel.rsplit_once('.') {
                Some((layer, _)) => layer,
                None => part.name.as_deref().unwrap_or_default(),
            };
            // Stereo views are named `<layer>.<view>` in channels, `<layer>-<view>` in parts.
            let rest = layer.get(name.len()..);
            rest.is_some_and(|rest| {
                layer[..name.len()].eq_ignore_ascii_case(name)
                    && (rest.is_empty() || self.views().iter().any(|view| rest.get(1..) == Some(view)))
            })
        };
        let is_foreign = |(index, part): (usize, &super::Part)| {
            part.channels.iter().any(|channel| is_named(part, &channel.name))
                && !self.marked(index).iter().any(|layer| layer == name)
        };
        self.parts.iter().enumerate().any(is_foreign)
    }

    /// The layers of a part that demc made.
    fn marked(&self, part: usize) -> Vec<String> {
        let list = self.stored[part].attributes.text(MARK).unwrap_or_default();
        list.lines().map(str::to_owned).collect()
    }

    /// Overwrites existing channels of a part, by index: those of the layer `name`, such as
    /// `ViewLayer.Combined`.
    ///
    /// # Errors
    /// The part cannot be decoded or encoded.
    ///
    /// # Panics
    /// If there is no such channel, or one has not as many values as the part has pixels.
    pub fn replace(
        &mut self,
        part: usize,
        name: &str,
        channels: &[(usize, &[f32])],
    ) -> Result<Option<Recoded>> {
        let header = self.layout(part)?;
        let named: Named<'_> = channels
            .iter()
            .map(|&(index, values)| {
                assert_eq!(values.len(), header.layer_size.area(), "one value for each pixel");
                // The name as it is stored, which in old files need not be UTF-8.
                let name = header.channels.list[index].name.as_slice().to_vec();
                (name, NewChannel { component: "", kind: self.parts[part].channels[index].kind, values })
            })
            .collect();
        let recoded = self.set_channels(part, &named, None)?;
        self.mark(part, name);
        Ok(recoded)
    }

    /// Whether an added layer gets a part of its own. Blender 5 writes one part per pass: its files have
    /// several parts, or one that is named like all of its channels (`ViewLayer.Combined`).
    fn is_part_per_pass(&self, part: usize) -> bool {
        let of_its_own = |p: &super::Part| match &p.name {
            Some(name) if name.contains('.') => p
                .channels
                .iter()
                .all(|c| c.name.strip_prefix(name.as_str()).is_some_and(|rest| rest.starts_with('.'))),
            _ => false,
        };
        // Blocks that hold halved chroma are kept as they are: what is added gets a part of its own.
        let is_subsampled = chroma::is_subsampled(&self.stored[part].layout);
        self.is_multi_part() || is_subsampled || of_its_own(&self.parts[part])
    }

    fn add_part(&mut self, beside: usize, name: &str, channels: &Named<'_>) -> Result<()> {
        if self.parts.iter().any(|part| part.name.as_deref() == Some(name)) {
            let why = format!(
                "has a part '{name}' already, which demc did not make; choose another name for the result (--layer NAME)"
            );
            return Err(Error::invalid(&self.path, why));
        }
        let Stored { attributes: old, layout: like } = &self.stored[beside];
        let blocks = match like.blocks {
            BlockDescription::ScanLines => BlockDescription::ScanLines,
            BlockDescription::Tiles(mut tiles) => {
                tiles.level_mode = LevelMode::Singular;
                BlockDescription::Tiles(tiles)
            }
        };
        let mut layout = like.clone().with_encoding(like.compression, blocks, like.line_order);
        layout.channels = channel_list(channels.iter().map(|(n, c)| describe(n, c.kind)).collect());
        // The new part is another layer of the same picture, with the colour space, camera and view of the
        // part beside.
        let mut attributes = old.clone();
        attributes.0.retain(|attribute| {
            let is_own = OWN.iter().any(|own| own.as_bytes() == attribute.name);
            !is_own && !attribute.name.starts_with(CRYPTOMATTE)
        });
        attributes.set_text("name", name);
        attributes.set_layout(&layout);
        if let BlockDescription::Tiles(tiles) = blocks {
            attributes.set("tiles", "tiledesc", write_tiles(tiles));
        }
        let part = self.stored.len();
        let encoder = Encoder::new(&layout, part, None, channels);
        let chunks = layout
            .enumerate_ordered_blocks()
            .collect::<Vec<_>>()
            .into_par_iter()
            .map(|(index, tile)| {
                let at = layout.get_absolute_block_pixel_coordinates(tile.location)?;
                let at = BlockIndex {
                    layer: part,
                    pixel_position: at.position.to_usize("block position")?,
                    pixel_size: at.size,
                    level: tile.location.level_index,
                };
                encoder.encode((index, tile.location), at, None)
            })
            .collect::<exr::error::Result<Vec<_>>>();
        self.chunks.extend(chunks.map_err(|e| Self::error(&self.path, e))?);
        self.stored.push(Stored { attributes, layout });
        self.multi_part = true;
        self.stored.iter_mut().for_each(Stored::complete_for_several);
        self.describe();
        Ok(())
    }

    /// Adds channels to a part, or replaces those of the same name, and of the same layer, where it is said how its
    /// channels' names begin.
    fn set_channels(
        &mut self,
        part: usize,
        new: &Named<'_>,
        outdated: Option<&str>,
    ) -> Result<Option<Recoded>> {
        self.refuse_undecodable(part)?;
        let is_chroma = new.iter().any(|(name, _)| chroma::is_chroma(name));
        if is_chroma || chroma::is_subsampled(&self.stored[part].layout) {
            let why = "holds luminance and chroma, which no colours can replace; leave out --replace, and they are added";
            return Err(Error::invalid(&self.path, why));
        }
        let Stored { attributes: old_attributes, layout: old } = &self.stored[part];
        let is_new = |name: &Text| new.iter().any(|(n, _)| name.as_slice() == n.as_slice());
        let is_outdated = |name: &Text| {
            let component = outdated.and_then(|layer| name.as_slice().strip_prefix(layer.as_bytes()));
            component.is_some_and(|component| !component.contains(&b'.'))
        };
        let kept = || old.channels.list.iter().filter(|c| !is_new(&c.name) && !is_outdated(&c.name));
        let loses = kept().any(|c| !survives(old.compression, c.sample_type));
        let compression = if loses { Compression::ZIP16 } else { old.compression };

        let list = kept().cloned().chain(new.iter().map(|(n, c)| describe(n, c.kind))).collect();
        let mut layout = old.clone().with_encoding(compression, old.blocks, old.line_order);
        layout.channels = channel_list(list);
        let mut attributes: Attributes = old_attributes.clone();
        attributes.set_layout(&layout);

        let recoded = loses.then(|| Recoded { from: super::compression_name(old.compression) });
        let encoder = Encoder::new(&layout, part, Some(old), new);
        let encoded: Vec<Vec<StoredChunk>> = self
            .chunks
            .par_iter()
            .filter(|stored| stored.part == part)
            .map(|stored| encoder.recode(stored, &self.decompress(stored)?, &self.path))
            .collect::<Result<_>>()?;
        drop(encoder);

        // New chunks take the old ones' places in the file.
        let mut encoded = encoded.into_iter();
        let mut chunks = Vec::with_capacity(self.chunks.len());
        for stored in std::mem::take(&mut self.chunks) {
            match stored.part == part {
                true => chunks.extend(encoded.next().expect("every chunk of the part was encoded")),
                false => chunks.push(stored),
            }
        }
        self.chunks = chunks;
        self.stored[part] = Stored { attributes, layout };
        self.describe();
        Ok(recoded)
    }
}

impl Stored {
    /// Adds the attributes that a part must have in a file of several.
    fn complete_for_several(&mut self) {
        let Self { attributes, layout } = self;
        let kind = match (layout.blocks, layout.deep) {
            (BlockDescription::ScanLines, false) => "scanlineimage",
            (BlockDescription::Tiles(_), false) => "tiledimage",
            (BlockDescription::ScanLines, true) => "deepscanline",
            (BlockDescription::Tiles(_), true) => "deeptile",
        };
        attributes.set_text("type", kind);
        if attributes.text("name").is_none() {
            attributes.set_text("name", BEAUTY);
        }
        attributes.set_chunk_count(layout);
    }
}

/// Whether channels that this compression once stored and decoded come out the same when stored so
/// again: lossless kinds, and PXR24, whose 24-bit floats are exact the second time.
fn survives(compression: Compression, kind: SampleType) -> bool {
    compression == Compression::PXR24 || compression.is_lossless_for(kind)
}

fn describe(name: &[u8], kind: SampleKind) -> ChannelDescription {
    let kind = match kind {
        SampleKind::Half => SampleType::F16,
        SampleKind::Float => SampleType::F32,
        SampleKind::Uint => SampleType::U32,
    };
    // Radiance is marked as not "perceptually linear", as Blender marks it.
    ChannelDescription::new(Text::from_slice_unchecked(name), kind, false)
}

fn channel_list(mut channels: Vec<ChannelDescription>) -> ChannelList {
    channels.sort_by(|a, b| a.name.as_slice().cmp(b.name.as_slice()));
    ChannelList::new(channels.into())
}

/// Where a channel of the new part comes from.
enum Source<'a> {
    /// The channel at this index of the part as it was.
    Kept(usize),
    New(&'a [f32]),
}

/// Builds the blocks of one part from its old blocks and new planes.
struct Encoder<'a> {
    layout: &'a Header,
    part: usize,
    old: Option<&'a Header>,
    /// One for each channel of the new part.
    sources: Vec<Source<'a>>,
}

impl<'a> Encoder<'a> {
    fn new(layout: &'a Header, part: usize, old: Option<&'a Header>, new: &'a Named<'a>) -> Self {
        let source = |channel: &ChannelDescription| {
            let fresh = new.iter().find(|(n, _)| channel.name.as_slice() == n.as_slice());
            fresh.map(|(_, c)| Source::New(c.values)).unwrap_or_else(|| {
                let kept = old.and_then(|h| h.channels.find_index_of_channel(&channel.name));
                Source::Kept(kept.expect("a channel that is not new was there before"))
            })
        };
        let sources = layout.channels.list.iter().map(source).collect();
        Self { layout, part, old, sources }
    }

    /// The new chunks of one old block: one, or several where ZIP's 16 rows replace longer blocks
    /// (all block heights divide one another, and blocks start at the top of the data window).
    fn recode(
        &self,
        stored: &StoredChunk,
        block: &UncompressedBlock,
        path: &std::path::Path,
    ) -> Result<Vec<StoredChunk>> {
        let whole = block.index;
        let rows = match self.layout.blocks {
            BlockDescription::Tiles(_) => whole.pixel_size.height(),
            BlockDescription::ScanLines => self.layout.compression.scan_lines_per_block(),
        };
        let (top, height) = (whole.pixel_position.y(), whole.pixel_size.height());
        let mut chunks = (0..height)
            .step_by(rows)
            .map(|y| {
                let at = BlockIndex {
                    pixel_position: Vec2(whole.pixel_position.x(), top + y),
                    pixel_size: Vec2(whole.pixel_size.width(), rows.min(height - y)),
                    ..whole
                };
                let place = match self.layout.blocks {
                    BlockDescription::Tiles(_) => (stored.index, stored.place),
                    BlockDescription::ScanLines => {
                        let index = (top + y) / rows;
                        (index, TileCoordinates { tile_index: Vec2(0, index), ..stored.place })
                    }
                };
                self.encode(place, at, Some((block, y)))
            })
            .collect::<exr::error::Result<Vec<_>>>()
            .map_err(|e| Frame::error(path, e))?;
        if self.layout.line_order == LineOrder::Decreasing {
            chunks.reverse();
        }
        Ok(chunks)
    }

    /// One block: kept channels from the old block (from its row `y` on), new ones from their planes.
    fn encode(
        &self,
        (index, place): (usize, TileCoordinates),
        at: BlockIndex,
        old: Option<(&UncompressedBlock, usize)>,
    ) -> exr::error::Result<StoredChunk> {
        let header = self.layout;
        let mut data = Vec::with_capacity(at.pixel_size.area() * header.channels.bytes_per_pixel);
        for row in 0..at.pixel_size.height() {
            for (channel, source) in header.channels.list.iter().zip(&self.sources) {
                match (source, old, self.old) {
                    (Source::Kept(c), Some((block, y)), Some(old_header)) => {
                        data.extend_from_slice(&block.data[row_bytes(old_header, block.index, *c, y + row)]);
                    }
                    (Source::Kept(_), ..) => unreachable!("kept channels come with the old block"),
                    (Source::New(values), ..) => {
                        let line = self.line(values, at, row);
                        push_values(&mut data, &line, channel.sample_type);
                    }
                }
            }
        }
        let bytes = zip::compress(UncompressedBlock { index: at, data }, header)?;
        Ok(StoredChunk { part: self.part, index, place, bytes: Bytes::Held(bytes) })
    }

    /// One row of a block of new values; smaller resolution levels take the mean of what they cover.
    fn line(&self, values: &'a [f32], at: BlockIndex, row: usize) -> std::borrow::Cow<'a, [f32]> {
        let (width, height) = (self.layout.layer_size.width(), self.layout.layer_size.height());
        let (x0, y) = (at.pixel_position.x(), at.pixel_position.y() + row);
        let count = at.pixel_size.width();
        if at.level == Vec2(0, 0) {
            return values[y * width + x0..][..count].into();
        }
        let BlockDescription::Tiles(tiles) = self.layout.blocks else {
            unreachable!("only tiled parts have resolution levels")
        };
        let level_width = compute_level_size(tiles.rounding_mode, width, at.level.x());
        let level_height = compute_level_size(tiles.rounding_mode, height, at.level.y());
        let span = |i: usize, small: usize, full: usize| {
            let start = i * full / small;
            start..((i + 1) * full / small).max(start + 1)
        };
        let mean = |x: usize| {
            let (columns, rows) = (span(x, level_width, width), span(y, level_height, height));
            let n = (columns.len() * rows.len()) as f32;
            rows.flat_map(|y| &values[y * width..][columns.clone()]).sum::<f32>() / n
        };
        (x0..x0 + count).map(mean).collect()
    }
}

/// Appends values in native byte order, as `exr` wants uncompressed blocks.
fn push_values(data: &mut Vec<u8>, values: &[f32], kind: SampleType) {
    match kind {
        SampleType::F16 => {
            // A finite value beyond the range of half must not become infinite.
            let bounded = |v: &f32| if v.is_finite() { v.clamp(-HALF_MAX, HALF_MAX) } else { *v };
            let halves = Vec::<f16>::from_f32_slice(&values.iter().map(bounded).collect::<Vec<f32>>());
            push_bytes(data, halves.into_iter().map(f16::to_ne_bytes));
        }
        SampleType::F32 => push_bytes(data, values.iter().map(|v| v.to_ne_bytes())),
        SampleType::U32 => push_bytes(data, values.iter().map(|v| (v.round() as u32).to_ne_bytes())),
    }
}

/// Appends values of `N` bytes. Memory is taken for all of them first, or there would be a check for room at
/// each byte.
fn push_bytes<const N: usize>(data: &mut Vec<u8>, values: impl ExactSizeIterator<Item = [u8; N]>) {
    let start = data.len();
    data.resize(start + N * values.len(), 0);
    let places = data[start..].as_chunks_mut::<N>().0;
    places.iter_mut().zip(values).for_each(|(place, value)| *place = value);
}
