#!/usr/bin/env bash
# Trains on a machine that is lent for minutes, from packs in PACKS: first the prefilter, then the network,
# and leaves weights, logs and checkpoints in OUT. Run again with the same OUT it goes on where it was.
#
#   PACKS=packs OUT=run MODEL=demc-m PREFILTER_MINUTES=2 MINUTES=7 bash eval/twin/lent_gpu.sh
#
# PREFILTER=weights takes a prefilter that is trained already. Packs named val*.pack are validated on.
set -euo pipefail
here=$(dirname "$0")
: "${PACKS:?a folder of packs}" "${OUT:?a folder for the results}"
model=${MODEL:-demc-m} prefilter=${PREFILTER:-}
export PYTHONUNBUFFERED=1
mapfile -t val < <(find "$PACKS" -name 'val*.pack' | sort)
mapfile -t data < <(find "$PACKS" -name '*.pack' ! -name 'val*' | sort)
[ ${#val[@]} -gt 0 ] || { echo "lent_gpu.sh: no val*.pack in $PACKS to validate on" >&2; exit 2; }
common=(--data "${data[@]}" --val "${val[@]}" --every 45 --resume --batch "${BATCH:-48}" --leak "${LEAK:-0.01}")
if [ -z "$prefilter" ]; then
    python3 "$here/train.py" --model prefilter --size-of "$model" --loss geomean --minutes "${PREFILTER_MINUTES:-2}" \
        --lr 2e-3:1e-6 --weight-decay 0.1 --out "$OUT/prefilter" "${common[@]}"
    prefilter=$OUT/prefilter/last.safetensors
fi
python3 "$here/train.py" --model "$model" --prefilter "$prefilter" --raw-references --guide-dropout "${GUIDE_DROPOUT:-0.15}" \
    --minutes "${MINUTES:-7}" --lr 3e-3:1e-6 --weight-decay 0.2 --out "$OUT/$model" "${common[@]}"
