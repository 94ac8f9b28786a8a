//! A heat map: the ratio of each method's error on each case to another error, which the title names.
//!
//! Each row is a case and each column a method; the methods are repeated for each group of columns (a sample
//! count). Blue is below one and red above, on a logarithmic scale whose ends are a tenth and ten; each cell
//! has its number. A frame marks a cell that is out of bounds, and a cross one that has no number.

use plotters::prelude::*;

use super::{
    canvas::{Anchor, Canvas, Style},
    figure::Figure,
    palette::{FAINT, INK, mix},
};
use crate::Result;

/// Height of a row, and width of a cell.
const ROW: i32 = 20;
const CELL: i32 = 44;
/// Space around all, between groups, and for the title and the names of groups.
const MARGIN: i32 = 16;
const GROUP_GAP: i32 = 12;
const TITLE: i32 = 52;
const GROUP: i32 = 24;
const LABEL: Style = Style::new(13);
const VALUE: Style = Style::new(11);
/// The ratio at the red end of the scale; the blue end is its inverse.
const FULL: f64 = 10.0;
/// Ratios whose colour is light enough for dark numbers.
const LIGHT: std::ops::RangeInclusive<f64> = 0.22..=4.5;
const BETTER: RGBColor = RGBColor(33, 102, 172);
const WORSE: RGBColor = RGBColor(178, 24, 43);
const MISSING: RGBColor = RGBColor(240, 240, 242);

/// One cell.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct HeatCell {
    /// The ratio; none where there is no number.
    pub value: Option<f64>,
    /// Whether it is out of bounds.
    pub is_marked: bool,
}

/// A map of cells.
pub struct HeatMap {
    /// What the numbers are.
    pub title: String,
    /// The methods, in the order of columns.
    pub methods: Vec<String>,
    /// Names of the groups of columns; a single group may have an empty name.
    pub groups: Vec<String>,
    /// Each case with its cells, group by group, method by method.
    pub rows: Vec<(String, Vec<HeatCell>)>,
}

impl HeatMap {
    fn labels(&self) -> i32 {
        self.rows.iter().map(|(label, _)| LABEL.measure(label).0).max().unwrap_or(0) + 10
    }

    /// Height of the methods' names, which are written upwards.
    fn names(&self) -> i32 {
        self.methods.iter().map(|name| LABEL.measure(name).0).max().unwrap_or(0) + 10
    }

    fn top(&self) -> i32 {
        let has_names = self.groups.iter().any(|group| !group.is_empty());
        TITLE + if has_names { GROUP } else { 0 } + self.names()
    }

    /// The left edge of a column.
    fn column(&self, group: usize, method: usize) -> i32 {
        let group_width = CELL * self.methods.len() as i32 + GROUP_GAP;
        MARGIN + self.labels() + group as i32 * group_width + method as i32 * CELL
    }
}

/// Blue, white or red.
fn colour(ratio: f64) -> RGBColor {
    let place = (ratio.max(f64::MIN_POSITIVE).log10() / FULL.log10()).clamp(-1.0, 1.0);
    mix(WHITE, if place < 0.0 { BETTER } else { WORSE }, place.abs())
}

impl Figure for HeatMap {
    fn size(&self) -> (u32, u32) {
        let width = self.column(self.groups.len(), 0) - GROUP_GAP + MARGIN;
        let heading = Style { bold: true, ..Style::new(18) }.measure(&self.title).0 + 2 * MARGIN;
        let height = self.top() + ROW * self.rows.len() as i32 + MARGIN;
        (width.max(heading) as u32, height as u32)
    }

    fn draw<B: DrawingBackend>(&self, canvas: &Canvas<B>) -> Result<()> {
        let heading = Style { bold: true, ..Style::new(18) };
        canvas.text(&self.title, (MARGIN, 28), Anchor::Left, heading)?;
        let top = self.top();
        for (g, group) in self.groups.iter().enumerate() {
            let middle = (self.column(g, 0) + self.column(g, self.methods.len())) / 2;
            let style = Style { bold: true, ..Style::new(15) };
            canvas.text(group, (middle, TITLE + GROUP / 2), Anchor::Centre, style)?;
            for (m, name) in self.methods.iter().enumerate() {
                let at = (self.column(g, m) + CELL / 2, top - 6 - LABEL.measure(name).0 / 2);
                canvas.vertical_text(name, at, LABEL)?;
            }
        }
        // Frames come last: the next cell would cover their edges.
        let mut frames = Vec::new();
        for (r, (label, cells)) in self.rows.iter().enumerate() {
            let y = top + ROW * r as i32;
            let right = self.column(0, 0) - 8;
            canvas.text(label, (right, y + ROW / 2), Anchor::Right, LABEL)?;
            for (i, cell) in cells.iter().enumerate() {
                let x = self.column(i / self.methods.len(), i % self.methods.len());
                let corners = [(x, y), (x + CELL - 1, y + ROW - 1)];
                let middle = (x + CELL / 2, y + ROW / 2);
                match cell.value {
                    Some(value) => {
                        let fill = colour(value);
                        canvas.fill(corners, fill)?;
                        let ink = if LIGHT.contains(&value) { INK } else { WHITE };
                        canvas.text(&short(value), middle, Anchor::Centre, Style { colour: ink, ..VALUE })?;
                    }
                    None => {
                        canvas.fill(corners, MISSING)?;
                        canvas.text("×", middle, Anchor::Centre, Style { colour: FAINT, ..VALUE })?;
                    }
                }
                if cell.is_marked {
                    let (right, bottom) = (x + CELL - 2, y + ROW - 2);
                    frames.push([(x, y), (right, y), (right, bottom), (x, bottom), (x, y)]);
                }
            }
        }
        // As lines, since plotters gives rectangles no stroke width in SVG.
        frames.into_iter().try_for_each(|corners| canvas.line(&corners, INK, 2))
    }
}

/// Few enough digits for a cell.
fn short(value: f64) -> String {
    match value {
        v if v >= 1000.0 => format!("{v:.0e}"),
        v if v >= 10.0 => format!("{v:.0}"),
        v if v >= 0.1 => format!("{v:.2}"),
        v if v >= 0.001 => format!("{v:.3}"),
        0.0 => "0".into(),
        v => format!("{v:.0e}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::canvas::draw_svg;

    #[test]
    fn every_cell_has_its_number_its_colour_and_its_mark() {
        let cell = |value: f64| HeatCell { value: Some(value), is_marked: value > 1.0 };
        let map = HeatMap {
            title: "ratio".into(),
            methods: vec!["noisy".into(), "demc-m".into()],
            groups: vec!["4 spp".into(), "64 spp".into()],
            rows: vec![
                ("fog".into(), vec![cell(1.0), cell(0.05), cell(1.0), cell(2.5)]),
                ("hair".into(), vec![cell(1.0), HeatCell::default(), cell(1.0), cell(12.0)]),
            ],
        };
        let svg = draw_svg(map.size(), |canvas| map.draw(canvas)).unwrap();
        for expected in ["fog", "hair", "demc-m", "64 spp", "0.050", "2.50", ">\n12\n", "×"] {
            assert!(svg.contains(expected), "{expected}: {svg}");
        }
        assert_eq!(svg.matches("stroke-width=\"2\"").count(), 2, "two are out of bounds");
        assert_eq!((colour(1.0), colour(10.0), colour(1e-9)), (WHITE, WORSE, BETTER));
    }

    #[test]
    fn numbers_fit_their_cells() {
        for value in [0.0, 1e-12, 0.00012, 0.0123, 0.5, 1.0, 99.94, 12345.0, 1e30] {
            assert!(VALUE.measure(&short(value)).0 <= CELL, "{value}: {}", short(value));
        }
    }
}
