//! What a file's name tells: the number of a frame, which stands at its end, of any width, as Blender writes
//! it before the extension (`shot_0004spp.0017.exr`, `shot0017.exr`, `shot.-0003.exr`; of one eye `shot_0017_L.exr`),
//! and samples per pixel.

use std::path::Path;

/// How the names of files of one eye end: by Blender's own suffixes of its stereo views, or those of others.
const EYES: [&str; 4] = ["_L", "_R", "_left", "_right"];

/// The frame number that a file's name ends in; none where it ends in none.
pub fn frame_number(file: &Path) -> Option<i64> {
    split(&file.file_stem()?.to_string_lossy()).map(|(_, number, _)| number)
}

/// What stands before the number at the end of a name without its extension, the number, and the suffix of an eye that
/// follows it, empty where there is none.
pub fn split(name: &str) -> Option<(&str, i64, &str)> {
    let stem = EYES.iter().find_map(|eye| name.strip_suffix(eye)).unwrap_or(name);
    let eye = &name[stem.len()..];
    let head = stem.trim_end_matches(|c: char| c.is_ascii_digit());
    let number: i64 = stem[head.len()..].parse().ok()?;
    // A minus is the number's where it stands for nothing else: at the beginning, or after a dot or a `_`, as in
    // Blender's `shot_-0003.exr`.
    Some(match head.strip_suffix('-') {
        Some(rest) if rest.is_empty() || rest.ends_with(['.', '_']) => (rest, -number, eye),
        _ => (head, number, eye),
    })
}

/// The samples per pixel in a name: those of `shot_0004spp.0017.exr`, `shot_0004spp_a.exr`.
pub fn samples(file: &Path) -> Option<u32> {
    let stem = file.file_stem()?.to_string_lossy();
    let (head, rest) = stem.rsplit_once("spp")?;
    let is_end = rest.is_empty() || rest.starts_with(['.', '_']);
    let (_, digits) = head.rsplit_once('_').filter(|_| is_end)?;
    digits.parse().ok().filter(|_| digits.bytes().all(|b| b.is_ascii_digit()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frame_numbers_end_names() {
        for (stem, expected) in [
            ("shot_0004spp.0017", Some(("shot_0004spp.", 17, ""))),
            ("shot0017", Some(("shot", 17, ""))),
            ("shot_10017", Some(("shot_", 10017, ""))),
            ("shot-0017", Some(("shot-", 17, ""))),
            ("shot.-0003", Some(("shot.", -3, ""))),
            ("shot_-0003", Some(("shot_", -3, ""))),
            ("0001", Some(("", 1, ""))),
            ("-0003", Some(("", -3, ""))),
            ("shot_0017_L", Some(("shot_", 17, "_L"))),
            ("shot_-0017_right", Some(("shot_", -17, "_right"))),
            ("shot_L", None),
            ("shot_0004spp", None),
            ("shot", None),
            ("a99999999999999999999", None),
        ] {
            assert_eq!(split(stem), expected, "{stem}");
        }
        assert_eq!(frame_number(Path::new("a-3/shot-0017.exr")), Some(17));
    }

    #[test]
    fn samples_stand_before_spp() {
        for (name, expected) in [
            ("a/shot_0004spp.0017.exr", Some(4)),
            ("shot_256spp.exr", Some(256)),
            ("shot_0016spp_n1.exr", Some(16)),
            ("a_4spp/shot.exr", None),
            ("shot_spp.exr", None),
            ("shot_+4spp.exr", None),
            ("shot_4sppx.exr", None),
            ("shot4spp.exr", None),
        ] {
            assert_eq!(samples(Path::new(name)), expected, "{name}");
        }
    }
}
