//! Sortable tables: a row for each method, the best value of a column marked.

use maud::{Markup, html};
use plotters::prelude::RGBColor;

use crate::report::{NOISY, chart::number_label};

/// Which values of a column are better, and come first when the page is sorted by it.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Better {
    Low,
    High,
    /// The column is a fact, such as a count, in which no value is better.
    Neither,
}

/// A column of numbers.
pub struct Column<T> {
    pub heading: &'static str,
    /// What it is, in words.
    pub hint: &'static str,
    pub better: Better,
    pub show: fn(f64) -> String,
    pub value: fn(&T) -> Option<f64>,
}

/// One line of a table.
pub struct Line<'a, T> {
    pub method: &'a str,
    pub colour: RGBColor,
    pub item: &'a T,
}

/// A table of `lines`, sortable by the page's script. Columns without any value are left out.
pub fn table<T>(columns: &[Column<T>], lines: &[Line<T>], caption: &str) -> Markup {
    let has_values = |c: &&Column<T>| lines.iter().any(|line| (c.value)(line.item).is_some());
    let columns: Vec<&Column<T>> = columns.iter().filter(has_values).collect();
    let best: Vec<Option<f64>> = columns.iter().map(|c| best(c, lines)).collect();
    html! {
        div.scroll { table.sortable {
            @if !caption.is_empty() { caption { (caption) } }
            thead { tr {
                (heading("method", "", "ascending", "text"))
                @for column in &columns {
                    @let first = if column.better == Better::High { "descending" } else { "ascending" };
                    (heading(column.heading, column.hint, first, "number"))
                }
            } }
            tbody {
                @for line in lines {
                    tr.noisy[line.method == NOISY] {
                        td data-value=(line.method) {
                            span.swatch style=(format!("background:{}", css(line.colour))) {}
                            (line.method)
                        }
                        @for (column, best) in columns.iter().zip(&best) {
                            @match (column.value)(line.item) {
                                Some(value) => td.top[*best == Some(value)] data-value=(value) {
                                    ((column.show)(value))
                                },
                                None => td { "–" },
                            }
                        }
                    }
                }
            }
        } }
    }
}

fn heading(text: &str, hint: &str, first: &str, kind: &str) -> Markup {
    html! {
        th scope="col" title=(hint) data-first=(first) data-kind=(kind) { button type="button" { (text) } }
    }
}

/// The best value of a column; none where nothing is compared.
fn best<T>(column: &Column<T>, lines: &[Line<T>]) -> Option<f64> {
    let values = lines.iter().filter(|l| l.method != NOISY).filter_map(|l| (column.value)(l.item));
    match column.better {
        _ if values.clone().count() < 2 => None,
        Better::Low => values.reduce(f64::min),
        Better::High => values.reduce(f64::max),
        Better::Neither => None,
    }
}

/// A colour as CSS writes it.
pub fn css(RGBColor(r, g, b): RGBColor) -> String {
    format!("#{r:02x}{g:02x}{b:02x}")
}

/// Four significant digits.
pub fn score(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return format!("{value}");
    }
    let magnitude = value.abs().log10().floor() as i32;
    if magnitude < -5 {
        return format!("{value:.3e}");
    }
    format!("{value:.*}", (3 - magnitude).clamp(0, 8) as usize)
}

/// Four decimals, for values between 0 and 1.
pub fn share(value: f64) -> String {
    format!("{value:.4}")
}

/// A multiple of the baseline.
pub fn ratio(value: f64) -> String {
    format!("{} ×", number_label(value))
}

/// A whole number, or one decimal for fractions below ten.
pub fn whole(value: f64) -> String {
    if value.abs() < 10.0 && value.fract() != 0.0 { format!("{value:.1}") } else { format!("{value:.0}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_is_marked_in_its_column_and_the_input_is_never_it() {
        let column = |better| Column::<f64> {
            heading: "relmse",
            hint: "",
            better,
            show: score,
            value: |v: &f64| v.is_finite().then_some(*v),
        };
        let line = |method, item| Line { method, colour: RGBColor(1, 2, 255), item };
        let lines = [line("noisy", &0.1), line("a", &0.5), line("b<i>", &0.25), line("c", &f64::NAN)];
        let text = table(&[column(Better::Low)], &lines, "").into_string();
        assert_eq!(text.matches("class=\"top\"").count(), 1);
        assert!(text.contains("<td class=\"top\" data-value=\"0.25\">0.2500</td>"), "{text}");
        assert!(text.contains("b&lt;i&gt;") && !text.contains("b<i>"), "names are escaped");
        assert!(text.contains("<td>–</td>") && text.contains("#0102ff"));
        let text = table(&[column(Better::High)], &lines, "").into_string();
        assert!(text.contains("<td class=\"top\" data-value=\"0.5\">"));
        let text = table(&[column(Better::Low)], &lines[..2], "").into_string();
        assert!(!text.contains("class=\"top\""), "one method is not the best of one");
    }

    #[test]
    fn numbers_read_well() {
        assert_eq!(score(0.0166497), "0.01665");
        assert_eq!(score(1.303102), "1.303");
        assert_eq!(score(121.7875), "121.8");
        assert_eq!(score(1.2e-9), "1.200e-9");
        assert_eq!(
            (ratio(1.0), ratio(0.0324), ratio(12.34)),
            ("1.00 ×".into(), "0.0324 ×".into(), "12.3 ×".into())
        );
        assert_eq!((whole(9.53), whole(954.89), whole(0.0)), ("9.5".into(), "955".into(), "0".into()));
    }
}
