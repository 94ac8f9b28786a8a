//! How much memory a piece of work added to this process, where the system tells (Linux).

use std::fs;

/// Runs `work`; also gives the growth of resident memory at its peak, in MiB. Memory that the process
/// held before, such as buffers kept from an earlier run, is not counted.
pub fn peak_mib<T>(work: impl FnOnce() -> T) -> (T, Option<f64>) {
    // Writing 5 resets the peak to the present size (proc(5), clear_refs).
    let reset = fs::write("/proc/self/clear_refs", "5").is_ok();
    let before = status_kib("VmRSS:");
    let result = work();
    let peak = match (reset, before, status_kib("VmHWM:")) {
        (true, Some(before), Some(peak)) => Some(peak.saturating_sub(before) as f64 / 1024.0),
        _ => None,
    };
    (result, peak)
}

/// A line of `/proc/self/status` that counts KiB.
fn status_kib(field: &str) -> Option<u64> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let rest = status.lines().find_map(|line| line.strip_prefix(field))?;
    rest.split_whitespace().next()?.parse().ok()
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    #[test]
    fn peak_sees_memory_that_was_freed_again() {
        let (sum, peak) = peak_mib(|| {
            let block = std::hint::black_box(vec![1u8; 96 << 20]);
            block.iter().map(|&b| u64::from(b)).sum::<u64>()
        });
        assert_eq!(sum, 96 << 20);
        let peak = peak.expect("Linux tells");
        assert!((90.0..400.0).contains(&peak), "{peak} MiB");
    }
}
