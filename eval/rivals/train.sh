#!/bin/sh
# Trains the paper's networks and the learned rivals on the same data, each for the same processor time:
#   eval/rivals/train.sh DATA HELD_OUT OUT SECONDS [NAME...]
# DATA and HELD_OUT are folders or manifests of pairs, to train on and to validate on. Learning rates fall over as many
# steps as fit nine tenths of the time on one thread with AVX512-BF16 beside a busy one; the environment variable SPEED
# corrects that for another processor (0.5 for one of half the speed), SEED takes another seed than 1, RAW=1 has errors taken
# against what clean_references.py cleaned as it was rendered. One thread each, one after another. A run that is cut by the
# budget keeps the best weights so far in OUT/NAME/best.safetensors. Given again, the command goes on where it was stopped;
# more SECONDS give a run that was cut the steps that it lacks, not more. OUT/NAME.seconds holds the time used so far. Of a run that goes astray, OUT/NAME/at-*.safetensors
# are checkpoints to go back to.
set -eu
data=$1 held_out=$2 out=$3 seconds=$4
shift 4
demc=${DEMC:-demc}
# shellcheck source=eval/rivals/recipe.sh
. "$(dirname "$0")/recipe.sh"
# shellcheck disable=SC2086 # the methods are words
[ $# -gt 0 ] || set -- $methods
mkdir -p "$out"
failed=0

# Becomes `demc train` for a method, with the options that follow its name.
run() {
    into=$out/$1
    shift
    exec "$demc" train --out "$into" --threads 1 "$@" 2>>"$into.log"
}

for name in "$@"; do
    recipe "$name"
    # A tenth is left for validation, and so that none is cut before its rate has fallen.
    steps=$(awk "BEGIN { print int(0.9 * $rate * $seconds / 100 * ${SPEED:-1}) }")
    spent=0
    if [ -e "$out/$name/checkpoint.safetensors" ]; then
        spent=$(cat "$out/$name.seconds")
        if [ "$spent" -ge "$seconds" ]; then continue; fi
        steps=$(sed -n 's/.*"steps": *\([0-9]*\).*/\1/p' "$out/$name/config.json" | head -n 1)
        run "$name" --resume &
    else
        every=$((steps / 30 > 0 ? steps / 30 : 1))
        # shellcheck disable=SC2046 # the options are words
        run "$name" --data "$data" --val "$held_out" --every "$every" $(options "$steps") &
    fi
    pid=$!
    # A shell's background jobs do not hear Ctrl-C.
    trap 'kill -TERM $pid 2>/dev/null; wait $pid; exit 130' INT TERM HUP
    used=$spent kept=0
    while kill -0 $pid 2>/dev/null; do
        sleep 1
        # Processor time, so that a busy machine takes nothing from any of them.
        time=$(ps -o cputimes= -p $pid | tr -d ' ')
        if [ -n "$time" ]; then used=$((spent + time)); fi
        echo "$used" >"$out/$name.seconds.tmp"
        mv "$out/$name.seconds.tmp" "$out/$name.seconds"
        # The checkpoint is of the last minute, so one is kept for every five validations.
        rows=$(cat "$out/$name/log.csv" 2>/dev/null | wc -l)
        if [ "$rows" -ge $((kept + 5)) ] && [ -e "$out/$name/checkpoint.safetensors" ]; then
            cp "$out/$name/checkpoint.safetensors" "$out/$name/at-$rows.safetensors"
            kept=$rows
        fi
        if [ "$used" -ge "$seconds" ]; then kill -TERM $pid 2>/dev/null || true; break; fi
    done
    status=0
    wait $pid 2>/dev/null || status=$?
    # 130: it was interrupted, as it is when its time is over.
    if [ $status -eq 130 ] && [ "$used" -ge "$seconds" ]; then
        echo "$name: cut before its $steps steps, at a rate that had not fallen to the end" >&2
    elif [ $status -ne 0 ]; then
        echo "$name failed (exit status $status): $(grep -E '^(error|demc):' "$out/$name.log" | tail -n 1)" >&2
        failed=1
        continue
    fi
    echo "$name: $used s of processor time; $(tail -n 1 "$out/$name/log.csv")"
done
exit $failed
