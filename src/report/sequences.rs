//! Sequences of a test set: each method's result on every frame, to step through, and slices through time.
//!
//! A slice is the same row of pixels of all frames, one below the other. Things that move make slanted lines
//! in it, things that stand still vertical lines, and flicker breaks the lines up. In: the images of sheets.
//! Out: `frames/<pair>/<method>.png`, and `slices/<scene>_<spp>spp.png`; pairs are called as their sheets are.

use std::{
    fs,
    path::{Path, PathBuf},
};

use image::{RgbImage, imageops};
use maud::{Markup, html};

use super::{
    canvas::{Anchor, Style, draw_on, write_png},
    followed::is_next,
    page::picture_of,
    picture,
    run::sheet_name,
    sheet::{BACKGROUND, Shown, TEXT},
};
use crate::{Error, Result, frame::prepare_folder, planes::Planes, testset::Pair};

/// Name of the reference among the methods.
const REFERENCE: &str = "reference";
/// Height in pixels of a frame's row in a slice.
const ROW: u32 = 10;
/// Height in pixels of a method's name in a slice.
const NAME: u32 = 22;
/// Width in pixels that slices side by side fill at most.
const WIDEST: u32 = 960;
/// Bytes that all frames to step through may take in a page.
const MOST_BYTES: usize = 6_000_000;

/// Frames that follow each other, at one sample count.
pub struct Sequence<'a> {
    /// The frames, two at least.
    pub pairs: Vec<&'a Pair>,
    /// The test set.
    all: &'a [Pair],
}

/// The sequences of a test set.
pub fn sequences(pairs: &[Pair]) -> Vec<Sequence<'_>> {
    let mut found: Vec<Sequence<'_>> = Vec::new();
    for pair in pairs.iter().filter(|pair| pair.frame.is_some()) {
        let goes_on = |sequence: &&mut Sequence<'_>| {
            is_next(pair, sequence.pairs.last().expect("it begins with a frame"))
        };
        match found.iter_mut().find(goes_on) {
            Some(sequence) => sequence.pairs.push(pair),
            None => found.push(Sequence { pairs: vec![pair], all: pairs }),
        }
    }
    found.retain(|sequence| sequence.pairs.len() > 1);
    found
}

/// The folder with the results on a frame, by the name of its sheet.
fn folder(out: &Path, sheet: &str) -> PathBuf {
    out.join("frames").join(sheet.trim_end_matches(".png").replace(':', "_"))
}

/// The file that shows a method's result. No two methods share one.
fn file(folder: &Path, method: &str) -> PathBuf {
    let write = |c: char| match c {
        '/' | '\\' | ':' | '%' => format!("%{:02X}", u32::from(c)),
        _ => c.into(),
    };
    folder.join(method.chars().map(write).collect::<String>() + ".png")
}

/// Stores each method's result on a frame, as the sheet of that name shows it, and the reference. Those of
/// earlier runs go.
///
/// # Errors
/// A file cannot be written.
pub fn store(out: &Path, sheet: &str, images: &[Shown], reference: &Planes) -> Result<()> {
    let folder = folder(out, sheet);
    if folder.exists() {
        fs::remove_dir_all(&folder).map_err(Error::io("remove", &folder))?;
    }
    prepare_folder(&folder)?;
    let reference = Shown::new(REFERENCE, reference, reference);
    images
        .iter()
        .chain([&reference])
        .try_for_each(|image| write_png(&file(&folder, image.name()), image.frame()))
}

impl Sequence<'_> {
    fn first(&self) -> &Pair {
        self.pairs[0]
    }

    /// Its name: the scene's, and the samples.
    fn label(&self) -> String {
        format!("{}, {} samples per pixel", self.first().scene, self.first().spp)
    }

    /// Its frames: "5 frames, 0001 to 0005".
    fn span(&self) -> String {
        let number = |pair: &Pair| pair.frame.clone().unwrap_or_default();
        let (first, last) = (number(self.first()), number(self.pairs[self.pairs.len() - 1]));
        format!("{} frames, {first} to {last}", self.pairs.len())
    }

    /// The file that shows a method's result on a frame.
    fn file(&self, out: &Path, pair: &Pair, method: &str) -> PathBuf {
        file(&folder(out, &sheet_name(self.all, pair)), method)
    }

    /// Those of the methods whose results on all frames are stored, and the reference last.
    fn shown<'m>(&self, out: &Path, methods: &'m [String]) -> Vec<&'m str> {
        let names = methods.iter().map(String::as_str).chain([REFERENCE]);
        names.filter(|name| self.pairs.iter().all(|pair| self.file(out, pair, name).is_file())).collect()
    }

    /// Writes the slice through the middle row; returns its path, or none where no frames are stored or their
    /// sizes differ.
    fn slice(&self, out: &Path, methods: &[&str]) -> Result<Option<PathBuf>> {
        let mut strips = Vec::new();
        for method in methods {
            let frames = self.pairs.iter().map(|pair| read(&self.file(out, pair, method)));
            strips.push((*method, frames.collect::<Result<Vec<RgbImage>>>()?));
        }
        let sizes = || strips.iter().flat_map(|(_, frames)| frames).map(RgbImage::dimensions);
        let Some(size) = sizes().next().filter(|size| sizes().all(|other| other == *size)) else {
            return Ok(None);
        };
        // The name of the first frame's sheet, without the frame where all that there are follow each other.
        let is_apart = |pair: &Pair| {
            let first = self.first();
            (&pair.scene, pair.spp) == (&first.scene, first.spp) && !self.pairs.contains(&pair)
        };
        let name = sheet_name(self.all, self.first());
        let frame = self.first().frame.as_ref().map(|frame| format!(".{frame}")).unwrap_or_default();
        let name = if self.all.iter().any(is_apart) { name } else { name.replacen(&frame, "", 1) };
        let path = out.join("slices").join(name);
        prepare_folder(path.parent().expect("it lies in a folder"))?;
        write_png(&path, &stack(&strips, size)?)?;
        Ok(Some(path))
    }
}

/// The middle rows of the frames of each method, methods side by side as far as there is room.
fn stack(strips: &[(&str, Vec<RgbImage>)], (width, height): (u32, u32)) -> Result<RgbImage> {
    let frames = strips.iter().map(|(_, frames)| frames.len()).max().unwrap_or(0) as u32;
    let count = strips.len() as u32;
    let columns = (WIDEST / width).clamp(1, count.max(1));
    let strip = NAME + frames * ROW;
    let corner = |s: usize| (s as u32 % columns * width, s as u32 / columns * strip);
    let mut image = RgbImage::from_pixel(columns * width, strip * count.div_ceil(columns), BACKGROUND);
    for (s, (_, frames)) in strips.iter().enumerate() {
        let (left, top) = corner(s);
        for (f, frame) in (0..).zip(frames) {
            let row = imageops::crop_imm(frame, 0, height / 2, width, 1).to_image();
            let tall = imageops::resize(&row, width, ROW, imageops::FilterType::Nearest);
            imageops::replace(&mut image, &tall, left.into(), (top + NAME + f * ROW).into());
        }
    }
    draw_on(&mut image, |canvas| {
        strips.iter().enumerate().try_for_each(|(s, (name, _))| {
            let (left, top) = corner(s);
            let at = (left as i32 + 6, (top + NAME / 2) as i32);
            canvas.text(name, at, Anchor::Left, Style { colour: TEXT, ..Style::new(14) })
        })
    })?;
    Ok(image)
}

fn read(path: &Path) -> Result<RgbImage> {
    picture::open(path).map(|image| image.to_rgb8())
}

/// What the page shows of all sequences; nothing where there are none.
///
/// # Errors
/// A picture cannot be read or written.
pub fn section(out: &Path, pairs: &[Pair], methods: &[String]) -> Result<Option<Markup>> {
    let mut parts = Vec::new();
    let mut bytes = 0;
    for sequence in sequences(pairs) {
        let shown = sequence.shown(out, methods);
        let Some(slice) = sequence.slice(out, &shown)? else { continue };
        let picture = picture_of(&slice, 1, &format!("{}: the middle row of every frame", sequence.label()))?;
        let mut frames = Vec::new();
        for (f, pair) in sequence.pairs.iter().enumerate() {
            for method in &shown {
                let image = picture::small(&sequence.file(out, pair, method))?;
                bytes += image.address.len();
                let name = pair.frame.clone().unwrap_or_else(|| (f + 1).to_string());
                frames.push((f, name, *method, image.address));
            }
        }
        let stepper = (bytes < MOST_BYTES).then(|| stepper(&frames, &shown, sequence.pairs.len()));
        parts.push(html! {
            h3 { (sequence.label()) ", " (sequence.span()) }
            @match stepper {
                Some(stepper) => (stepper),
                None => p.faint { "Its frames lie beside this page, in " code { "frames/" } "." },
            }
            p.faint { "The middle row of each frame, from the first down to the last:" }
            figure.slice { (picture) }
        });
    }
    if parts.is_empty() {
        return Ok(None);
    }
    Ok(Some(html! {
        h2 #sequences { "Sequences" }
        @for part in parts { (part) }
    }))
}

/// Two methods side by side, and a slider over the frames.
fn stepper(frames: &[(usize, String, &str, String)], methods: &[&str], count: usize) -> Markup {
    // Shown at first: the first method, which is usually `noisy`, beside the last one before the reference.
    let chosen = [0, methods.len().saturating_sub(2)];
    html! {
        div.stepper {
            div.panes {
                @for first in chosen {
                    div {
                        select aria-label="method" {
                            @for (m, method) in methods.iter().enumerate() {
                                option value=(method) selected[m == first] { (method) }
                            }
                        }
                        img.pane alt="the frame as this method shows it";
                    }
                }
            }
            label { "frame " input type="range" min="0" max=(count - 1) value="0"; " " output { (frames[0].1) } }
            @for (frame, name, method, address) in frames {
                img hidden data-frame=(frame) data-name=(name) data-method=(method) src=(address) alt="";
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pair(scene: &str, spp: u32, frame: Option<&str>) -> Pair {
        let suffix = frame.map(|frame| format!(".{frame}")).unwrap_or_default();
        Pair {
            scene: scene.into(),
            noisy: format!("{scene}_{spp:04}spp{suffix}.exr").into(),
            reference: format!("{scene}_ref{suffix}.exr").into(),
            spp,
            frame: frame.map(str::to_owned),
        }
    }

    #[test]
    fn no_two_methods_share_a_picture_and_no_two_scenes_a_sheet() {
        let names = ["a/w", "a_w", "a:w", "a%2Fw", "a\\w"];
        let files: std::collections::BTreeSet<PathBuf> =
            names.iter().map(|n| file(Path::new("f"), n)).collect();
        assert_eq!(files.len(), names.len(), "{files:?}");
        assert!(files.iter().all(|file| file.parent() == Some(Path::new("f"))));
        let pairs = ["kitchen/wide", "kitchen_wide", "Kitchen_Wide"].map(|scene| pair(scene, 4, None));
        let sheets: std::collections::BTreeSet<String> =
            pairs.iter().map(|pair| sheet_name(&pairs, pair).to_lowercase()).collect();
        assert_eq!(sheets.len(), pairs.len(), "{sheets:?}");
    }

    #[test]
    fn frames_that_follow_each_other_are_a_sequence() {
        let pairs = [
            pair("pan", 4, Some("0001")),
            pair("pan", 16, Some("0001")),
            pair("pan", 4, Some("0002")),
            pair("pan", 16, Some("0002")),
            pair("pan", 4, Some("0004")),
            pair("still", 4, None),
        ];
        let found: Vec<(u32, usize)> =
            sequences(&pairs).iter().map(|s| (s.first().spp, s.pairs.len())).collect();
        assert_eq!(found, [(4, 2), (16, 2)]);
    }

    #[test]
    fn shots_of_one_name_in_two_folders_have_pictures_of_their_own() {
        let out = tempfile::tempdir().unwrap();
        let of = |folder: &str, frame: &str| {
            let pair = pair("beauty", 4, Some(frame));
            Pair {
                noisy: Path::new(folder).join(&pair.noisy),
                reference: Path::new(folder).join(&pair.reference),
                ..pair
            }
        };
        let pairs = [of("A", "0001"), of("A", "0002"), of("B", "0001"), of("B", "0002")];
        assert_eq!(sequences(&pairs).len(), 2);
        let picture = |light: f32| Planes::from_rows(3, (40, 20), |_, _, row| row.fill(light));
        for (pair, light) in pairs.iter().zip([0.1, 0.1, 0.8, 0.8]) {
            let image = Shown::new("m", &picture(light), &picture(light));
            store(out.path(), &sheet_name(&pairs, pair), &[image], &picture(light)).unwrap();
        }
        section(out.path(), &pairs, &["m".to_owned()]).unwrap().unwrap();
        let files = |folder: &str| fs::read_dir(out.path().join(folder)).unwrap().count();
        assert_eq!((files("frames"), files("slices")), (4, 2));
    }

    #[test]
    fn a_slice_holds_the_middle_row_of_each_frame() {
        let out = tempfile::tempdir().unwrap();
        let pairs = [pair("pan", 4, Some("0001")), pair("pan", 4, Some("0002"))];
        let picture = |light: f32| Planes::from_rows(3, (40, 20), |_, _, row| row.fill(light));
        let reference = picture(0.5);
        for (pair, light) in pairs.iter().zip([0.0, 0.5]) {
            let sheet = sheet_name(&pairs, pair);
            let earlier = Shown::new("absent", &picture(light), &reference);
            store(out.path(), &sheet, &[earlier], &reference).unwrap();
            let image = Shown::new("a:b", &picture(light), &reference);
            store(out.path(), &sheet, &[image], &reference).unwrap();
        }
        let methods = ["a:b".to_owned(), "absent".to_owned()];
        let page = section(out.path(), &pairs, &methods).unwrap().unwrap().into_string();
        assert!(page.contains("pan, 4 samples") && page.contains("data-method=\"a:b\""), "{page}");
        assert!(!page.contains("absent"), "a method without frames is left out");
        assert_eq!(page.matches("data-frame=").count(), 4, "two frames, by the method and by the reference");
        let slice = read(&out.path().join("slices/pan_0004spp.png")).unwrap();
        assert_eq!(slice.dimensions(), (80, NAME + 2 * ROW), "the method beside the reference");
        let of = |frame: u32| slice.get_pixel(20, NAME + frame * ROW + ROW / 2)[0];
        assert!(of(0) < 5 && of(1) > 100, "{} {}", of(0), of(1));
        assert!(section(out.path(), &pairs[..1], &methods).unwrap().is_none());
    }
}
