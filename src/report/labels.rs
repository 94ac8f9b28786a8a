//! Finds places for the names of points: near each point, and where possible over nothing else.

use super::{axis::Area, canvas::Style};

/// A box in pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rect {
    /// Left edge.
    pub left: i32,
    /// Right edge.
    pub right: i32,
    /// Top edge.
    pub top: i32,
    /// Bottom edge.
    pub bottom: i32,
}

impl Rect {
    /// A box with this centre and size.
    pub fn around((x, y): (i32, i32), width: i32, height: i32) -> Self {
        Self { left: x - width / 2, right: x + width / 2, top: y - height / 2, bottom: y + height / 2 }
    }

    /// What a horizontal or vertical line from `a` to `b` covers.
    pub fn between(a: (i32, i32), b: (i32, i32)) -> Self {
        Self {
            left: a.0.min(b.0) - 1,
            right: a.0.max(b.0) + 1,
            top: a.1.min(b.1) - 1,
            bottom: a.1.max(b.1) + 1,
        }
    }

    /// Pixels that both cover.
    pub fn overlap(&self, other: &Self) -> i32 {
        let width = self.right.min(other.right) - self.left.max(other.left);
        let height = self.bottom.min(other.bottom) - self.top.max(other.top);
        width.max(0) * height.max(0)
    }

    /// Its middle.
    pub fn centre(&self) -> (i32, i32) {
        ((self.left + self.right) / 2, (self.top + self.bottom) / 2)
    }

    /// The place in it that is nearest to a point.
    pub fn nearest(&self, (x, y): (i32, i32)) -> (i32, i32) {
        (x.clamp(self.left, self.right), y.clamp(self.top, self.bottom))
    }

    /// Pixels between it and a point.
    pub fn distance(&self, at: (i32, i32)) -> i32 {
        let (x, y) = self.nearest(at);
        f64::from(x - at.0).hypot(f64::from(y - at.1)) as i32
    }
}

/// A box inside `area` for each of `names`, which belong to the points at `places`. Candidates lie on rings
/// around the point. The one is taken that overlaps `taken` and the labels before it least; among equals
/// one to which its own point is the nearest, and then the one on the smallest ring.
pub fn place(
    places: &[(i32, i32)],
    names: &[&str],
    style: Style,
    area: Area,
    mut taken: Vec<Rect>,
) -> Vec<Rect> {
    let mut labels = Vec::new();
    for (&(x, y), name) in places.iter().zip(names) {
        let (width, height) = style.measure(name);
        let (width, height) = (width + 6, height + 4);
        let candidates = [10, 24, 40, 58, 80, 110, 145, 185].into_iter().flat_map(|gap| {
            let (dx, dy) = (gap + width / 2, gap + height / 2);
            [(1, 0), (-1, 0), (0, -1), (0, 1), (1, -1), (-1, -1), (1, 1), (-1, 1)].map(|(sx, sy)| {
                // Diagonals start beside the point, not at the corner of the square around it.
                let diagonal = if sx != 0 && sy != 0 { 0.75 } else { 1.0 };
                let at = |s: i32, d: i32| (f64::from(s * d) * diagonal) as i32;
                Rect::around((x + at(sx, dx), y + at(sy, dy)), width, height)
            })
        });
        let inside = |r: &Rect| {
            r.left >= area.left + 2
                && r.right <= area.right
                && r.top >= area.top
                && r.bottom <= area.bottom - 2
        };
        // A name that is nearer to another point would be read as that one's.
        let misleads = |r: &Rect| places.iter().any(|&other| r.distance(other) < r.distance((x, y)));
        let cost = |r: &Rect| (taken.iter().map(|t| t.overlap(r)).sum::<i32>(), misleads(r));
        // `min_by_key` keeps the first of equals, the nearest.
        let best = candidates
            .filter(inside)
            .min_by_key(cost)
            .unwrap_or_else(|| Rect::around((x, y - height), width, height));
        taken.push(best);
        labels.push(best);
    }
    labels
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_of_crowded_points_overlap_neither_each_other_nor_a_point() {
        let names: Vec<String> = (0..14).map(|i| format!("oidn-high-prefilter-{i}")).collect();
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        let places: Vec<(i32, i32)> = (0..14).map(|i| (380 + i % 4 * 25, 300 + i / 4 * 20)).collect();
        let area = Area { left: 90, right: 780, top: 90, bottom: 680 };
        let dots: Vec<Rect> = places.iter().map(|&at| Rect::around(at, 16, 16)).collect();
        let labels = place(&places, &names, Style::new(14), area, dots.clone());
        for (i, a) in labels.iter().enumerate() {
            for b in labels[i + 1..].iter().chain(&dots) {
                assert_eq!(a.overlap(b), 0, "{a:?} {b:?}");
            }
        }
    }
}
