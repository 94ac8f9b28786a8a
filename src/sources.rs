//! Where the passes of a frame are, where their names do not tell: under names of the user's own, or in other
//! files.

use std::path::{Path, PathBuf};

use crate::{
    Error, Result,
    frame::Frame,
    frame_number::frame_number,
    passes::{self, Layer, Mapping, Pass, PassSet, Turn, to_camera_space},
    planes::Planes,
};

/// What the user says of where passes are.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Sources {
    /// What passes are called.
    pub mapping: Mapping,
    /// The file that holds the albedo, as renderers have it that write a file for each pass: see [`beside`].
    pub albedo: Option<PathBuf>,
    /// The file that holds the normal.
    pub normal: Option<PathBuf>,
}

/// The guides that may lie in other files.
const GUIDES: [Pass; 2] = [Pass::DenoisingAlbedo, Pass::DenoisingNormal];

/// A frame's file by a pattern: a run of `#`, or `%04d`, stands for the frame's number, which is the digits
/// at the end of its name. Without either the file is that of every frame.
///
/// # Errors
/// The pattern wants a number, and the frame has none.
pub fn beside(frame: &Path, pattern: &Path) -> Result<PathBuf> {
    let Some(Numbered { folder, head, width, tail, rest }) = numbered(pattern) else {
        return Ok(pattern.into());
    };
    let Some(number) = frame_number(frame) else {
        let pattern = pattern.display();
        let why = format!("its name ends in no number to put into {pattern}; rename it, or name one file");
        return Err(Error::invalid(frame, why));
    };
    // As Blender writes it: the width is that of the digits, whatever the sign.
    let sign = if number < 0 { "-" } else { "" };
    let part = folder.join(format!("{head}{sign}{:0width$}{tail}", number.unsigned_abs()));
    // An empty rest would add a slash.
    Ok(if rest.as_os_str().is_empty() { part } else { part.join(rest) })
}

/// Whether a pattern names another file for each frame.
pub fn has_number(pattern: &Path) -> bool {
    numbered(pattern).is_some()
}

/// A pattern that names another file for each frame.
struct Numbered {
    folder: PathBuf,
    /// What stands before the place of the number, its least width, and what stands behind, in one part of the
    /// path.
    head: String,
    width: usize,
    tail: String,
    /// The parts that come after it.
    rest: PathBuf,
}

/// Where the number has its place: in the last part of a pattern that has one and no file or folder for its
/// name.
fn numbered(pattern: &Path) -> Option<Numbered> {
    pattern.ancestors().find_map(|part| {
        let name = part.file_name()?.to_string_lossy();
        let (head, width, tail) = place(&name)?;
        if part.exists() {
            return None;
        }
        let rest = pattern.strip_prefix(part).expect("it begins so").to_owned();
        let folder = part.parent().unwrap_or(Path::new("")).to_owned();
        Some(Numbered { folder, head: head.into(), width, tail: tail.into(), rest })
    })
}

/// What stands in a name before the place of the number, the number's least width, and what stands behind.
fn place(name: &str) -> Option<(&str, usize, &str)> {
    if let Some(last) = name.rfind('#') {
        let head = name[..=last].trim_end_matches('#');
        return Some((head, last + 1 - head.len(), &name[last + 1..]));
    }
    let (head, rest) = name.rsplit_once('%')?;
    let (width, tail) = rest.split_once('d')?;
    let width = if width.is_empty() { Some(1) } else { width.parse().ok().filter(|width| *width < 20) };
    Some((head, width?, tail))
}

impl Sources {
    /// The files that hold guides of a frame.
    ///
    /// # Errors
    /// A pattern wants a number, and the frame has none.
    pub fn guides(&self, frame: &Path) -> Result<Vec<PathBuf>> {
        [&self.albedo, &self.normal].into_iter().flatten().map(|pattern| beside(frame, pattern)).collect()
    }

    /// Adds the guides that lie in other files, and makes normals those of Cycles unless Blender wrote them.
    /// Returns what the user should know.
    ///
    /// # Errors
    /// A file is unusable, holds no such pass, or is of another size.
    pub fn complete(
        &self,
        frame: &Frame,
        layer: &Layer,
        wanted: &[Pass],
        set: &mut PassSet,
    ) -> Result<Option<String>> {
        let mut matrix = frame.matrix_attribute("worldToCamera");
        let mut of_cycles = has_cycles_normal(layer);
        for (pass, pattern) in GUIDES.into_iter().zip([&self.albedo, &self.normal]) {
            if let Some(pattern) = pattern.as_deref().filter(|_| wanted.contains(&pass)) {
                let other = Frame::read(beside(frame.path(), pattern)?)?;
                let (own_layer, planes) = guide(&other, layer, pass, set)?;
                set.insert(pass, planes);
                if pass == Pass::DenoisingNormal {
                    of_cycles = has_cycles_normal(&own_layer);
                    matrix = other.matrix_attribute("worldToCamera").or(matrix);
                }
            }
        }
        if of_cycles {
            return Ok(None);
        }
        let Some(mut normals) = set.remove(Pass::DenoisingNormal) else { return Ok(None) };
        let change = to_camera_space(&mut normals, matrix);
        set.insert(Pass::DenoisingNormal, normals);
        // What was as it should be is not worth a word.
        let change = change.filter(|change| change.was_unit_range || change.turn != Turn::None);
        Ok(change.map(|change| change.to_string()))
    }
}

/// Whether a layer's normal is the pass that Cycles makes for denoisers.
fn has_cycles_normal(layer: &Layer) -> bool {
    // Programs write spaces and capitals otherwise.
    let names = Pass::DenoisingNormal.blender_names();
    let found = layer.passes.get(&Pass::DenoisingNormal);
    found.is_some_and(|at| names.iter().any(|name| passes::is_alike(name, &at.name)))
}

/// A guide in a file of its own: the pass, by its name, or what the file holds without one.
fn guide(frame: &Frame, of: &Layer, pass: Pass, set: &PassSet) -> Result<(Layer, Planes)> {
    let mut layers = passes::layers_of(frame, pass);
    let own_view = layers.iter().position(|layer| layer.view == of.view).unwrap_or(0);
    // A file with guides of several view layers has those of the one that is denoised, by its name.
    let own = layers
        .iter()
        .position(|layer| (&layer.name, &layer.view) == (&of.name, &of.view))
        .unwrap_or(own_view);
    if layers.is_empty() {
        let why =
            format!("holds no {pass} and no picture to take for it; `demc inspect` lists what it holds");
        return Err(Error::invalid(frame.path(), why));
    }
    let layer = layers.swap_remove(own);
    let mut found = passes::read_layer(frame, &layer, &[pass])?;
    set.check_same_pixels(&found, &format!("its {pass} in"))?;
    let planes = found.remove(pass).expect("the layer holds it");
    Ok((layer, planes))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_take_the_number_of_the_frame() {
        let named = |frame: &str, pattern: &str| {
            beside(Path::new(frame), Path::new(pattern)).map(|path| path.display().to_string())
        };
        assert_eq!(named("in/rgb.0017.exr", "in/albedo.####.exr").unwrap(), "in/albedo.0017.exr");
        assert_eq!(named("rgb0017.exr", "ALBEDO_#.exr").unwrap(), "ALBEDO_17.exr");
        assert_eq!(named("rgb.17.exr", "albedo.%04d.exr").unwrap(), "albedo.0017.exr");
        assert_eq!(named("rgb.12345.exr", "albedo.###.exr").unwrap(), "albedo.12345.exr");
        assert_eq!(named("rgb.0000.exr", "albedo.##.exr").unwrap(), "albedo.00.exr");
        assert_eq!(named("rgb.-0003.exr", "albedo.####.exr").unwrap(), "albedo.-0003.exr");
        assert_eq!(named("rgb.exr", "albedo.exr").unwrap(), "albedo.exr");
        assert_eq!(named("rgb.exr", "100%.exr").unwrap(), "100%.exr");
        assert_eq!(named("rgb.17.exr", "cut#3/50%done/albedo.#.exr").unwrap(), "cut#3/50%done/albedo.17.exr");
        assert_eq!(named("rgb.17.exr", "takes/####/albedo.exr").unwrap(), "takes/0017/albedo.exr");
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("take#2.exr");
        std::fs::write(&path, "").unwrap();
        assert!(beside(Path::new("rgb.17.exr"), &path).unwrap() == path && !has_number(&path));
        let inside = folder.path().join("50%done/albedo.exr");
        std::fs::create_dir(folder.path().join("50%done")).unwrap();
        assert!(beside(Path::new("rgb.17.exr"), &inside).unwrap() == inside);
        assert!(named("rgb.exr", "albedo.####.exr").unwrap_err().to_string().contains("no number"));
        assert!(has_number(Path::new("a.#.exr")) && !has_number(Path::new("a.exr")));
    }
}
