//! The number of a frame, which stands at the end of its file's name, of any width, as Blender writes it before the extension:
//! `shot_0004spp.0017.exr`, `shot0017.exr`, `shot.-0003.exr`.

use std::path::Path;

/// The frame number that a file's name ends in; none where it ends in none.
pub fn frame_number(file: &Path) -> Option<i64> {
    split(file.file_stem()?.to_str()?).map(|(_, number)| number)
}

/// What stands before the number at the end of a name without its extension, and the number.
pub fn split(stem: &str) -> Option<(&str, i64)> {
    let head = stem.trim_end_matches(|c: char| c.is_ascii_digit());
    let number: i64 = stem[head.len()..].parse().ok()?;
    // A minus is the number's where it stands for nothing else: at the beginning or after a dot.
    Some(match head.strip_suffix('-') {
        Some(rest) if rest.is_empty() || rest.ends_with('.') => (rest, -number),
        _ => (head, number),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frame_numbers_end_names() {
        for (name, expected) in [
            ("shot_0004spp.0017.exr", Some(17)),
            ("shot0017.exr", Some(17)),
            ("a-3/shot-0017.exr", Some(17)),
            ("shot.-0003.exr", Some(-3)),
            ("0001.exr", Some(1)),
            ("shot_0004spp.exr", None),
            ("shot.exr", None),
        ] {
            assert_eq!(frame_number(Path::new(name)), expected, "{name}");
        }
    }
}
