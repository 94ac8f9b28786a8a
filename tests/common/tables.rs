//! The tables that `demc` writes.

use std::{collections::HashMap, path::Path};

/// A row's cells by column.
pub type Row = HashMap<String, String>;

/// The rows of a CSV file.
pub fn table(path: &Path) -> Vec<Row> {
    let mut reader = csv::Reader::from_path(path).unwrap();
    reader.deserialize().map(Result::unwrap).collect()
}
