#!/bin/sh
# Trains the paper's networks and the learned rivals on the same data, each for the same processor time:
#   eval/rivals/train.sh DATA OUT SECONDS [NAME...]
# Learning rates fall over STEPS, which fit 480 seconds of one thread with AVX512-BF16 beside a busy one;
# scale them with the budget by the environment variable SCALE (2 for twice the steps). One thread each, one
# after another. A run that is cut by the budget keeps the best weights so far in OUT/NAME/best.safetensors.
set -eu
data=$1 out=$2 seconds=$3
shift 3
[ $# -gt 0 ] || set -- demc demc-nofusion semc kpcn lbf
demc=${DEMC:-demc}
mkdir -p "$out"

for name in "$@"; do
    case $name in
        demc) steps=1500 more="--loss relmse --lr 1e-3:5e-5" ;;
        demc-nofusion) steps=1750 more="--loss relmse --lr 1e-3:5e-5" ;;
        semc) steps=720 more="--loss relmse --lr 1e-3:5e-5" ;;
        kpcn) steps=360 more="--loss smape --lr 3e-4:3e-5 --patch 64" ;;
        lbf) steps=780 more="--loss both --lr 1e-2:1e-3 --patch 64" ;;
        *) echo "train.sh: no recipe for $name" >&2; exit 2 ;;
    esac
    steps=$(awk "BEGIN { print int($steps * ${SCALE:-1}) }")
    # shellcheck disable=SC2086 # the options are words
    "$demc" train --data "$data" --out "$out/$name" --model "$name" --threads 1 --seed 1 \
        --steps "$steps" --every $((steps / 10 > 0 ? steps / 10 : 1)) $more 2>"$out/$name.log" &
    pid=$!
    used=0
    while kill -0 $pid 2>/dev/null; do
        sleep 1
        # Processor time, so that a busy machine takes nothing from any of them.
        time=$(ps -o cputimes= -p $pid | tr -d ' ')
        used=${time:-$used}
        if [ "$used" -ge "$seconds" ]; then kill -INT $pid 2>/dev/null || true; wait $pid || true; break; fi
    done
    wait $pid 2>/dev/null || true
    echo "$name: $used s of processor time; $(tail -n 1 "$out/$name/log.csv")"
done
