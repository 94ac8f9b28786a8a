//! `log.csv`: one row for each interval of steps.

use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::{Error, Result, frame::atomically};

/// A row of `log.csv`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LogRow {
    /// Steps done.
    pub step: usize,
    /// Seconds of training in all, before and after resuming.
    pub seconds: f64,
    /// Learning rate of the last step.
    pub lr: f64,
    /// Mean training loss since the row before; none where every step since was skipped.
    pub train_loss: Option<f64>,
    /// Geometric mean of the validation frames' RelMSE (the mean would follow the worst one).
    pub val_relmse: Option<f64>,
    /// Mean of the validation frames' SSIM.
    pub val_ssim: Option<f64>,
}

/// Reads the rows up to `step`: a resumed run writes the later ones again.
pub fn read(path: &Path, step: usize) -> Result<Vec<LogRow>> {
    if !path.exists() {
        return Ok(Vec::new());
    }
    let foreign = |e: csv::Error| Error::invalid(path, format!("not a training log ({e}); remove it"));
    let rows: Vec<LogRow> = csv::Reader::from_path(path)
        .map_err(foreign)?
        .deserialize()
        .collect::<Result<_, _>>()
        .map_err(foreign)?;
    Ok(rows.into_iter().filter(|row| row.step <= step).collect())
}

/// Writes every row, whole or not at all.
pub fn write(path: &Path, rows: &[LogRow]) -> Result<()> {
    atomically(path, |file| {
        let mut writer = csv::Writer::from_writer(file);
        for row in rows {
            writer.serialize(row).map_err(|e| Error::invalid(path, e))?;
        }
        writer.flush().map_err(Error::io("write", path))
    })
}
