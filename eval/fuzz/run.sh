#!/usr/bin/env bash
# Mutates small files of every kind for as many cases as are asked for, in processes whose memory is limited,
# and says how many were refused. Stops at the first case that ends a process, and says how to see it again.
#     eval/fuzz/run.sh [CASES]
set -euo pipefail
cd "$(dirname "$0")/../.."
export DEMC_FUZZ_CASES=${1:-1000000} DEMC_FUZZ_SECONDS=86400
cargo test --release --test fuzz -- --nocapture no_damaged
