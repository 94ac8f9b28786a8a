#!/bin/sh
# Tries the same seven settings with every learned method, as far as it has them, for about the same time each:
#   eval/rivals/trials.sh DATA HELD_OUT OUT SECONDS [NAME...]
# DATA and HELD_OUT are folders or manifests of pairs. The settings are the recipe as it is; a learning rate 2.5
# times as large, or as small; twice or half as many crops a step; crops of half the size, as many pixels of them;
# no coloured light. Steps are as many as the recipe makes in SECONDS (SPEED as in train.sh), half as many of
# twice the crops. Writes OUT/trials.csv; trials that are in it already are not made again (another SEED wants another OUT).
set -eu
data=$1 held_out=$2 out=$3 seconds=$4
shift 4
demc=${DEMC:-demc}
# shellcheck source=eval/rivals/recipe.sh
. "$(dirname "$0")/recipe.sh"
# shellcheck disable=SC2086 # the methods are words
[ $# -gt 0 ] || set -- $methods
mkdir -p "$out"
table=$out/trials.csv
[ -e "$table" ] || echo "model,trial,lr,patch,batch,tint,steps,processor_seconds,relmse,ssim" >"$table"

# $1 after arithmetic, as a number that train takes.
compute() { awk "BEGIN { printf \"%g\", $1 }"; }

for name in "$@"; do
    for trial in recipe faster slower more-crops fewer-crops smaller-crops no-tint; do
        if grep -q "^$name,$trial," "$table"; then continue; fi
        recipe "$name"
        case $trial in
            faster) lr=$(compute "$lr * 2.5") ;;
            slower) lr=$(compute "$lr / 2.5") ;;
            more-crops) batch=$((batch * 2)) rate=$((rate / 2)) ;;
            fewer-crops) batch=$((batch / 2)) rate=$((rate * 2)) ;;
            smaller-crops) patch=$((patch / 2)) batch=$((batch * 4)) ;;
            no-tint) tint=0 ;;
        esac
        # There are no crops of less than 32x32, nor half ones.
        if [ "$patch" -lt 32 ] || [ "$batch" -lt 1 ]; then continue; fi
        steps=$(compute "int($rate * $seconds / 100 * ${SPEED:-1})")
        run=$out/$name-$trial
        rm -rf "$run"
        # shellcheck disable=SC2046 # the options are words
        "$demc" train --data "$data" --val "$held_out" --out "$run" --every "$steps" $(options "$steps") \
            --threads 1 2>"$run.log" &
        pid=$!
        # A shell's background jobs do not hear Ctrl-C.
        trap 'kill -TERM $pid 2>/dev/null; wait $pid; exit 130' INT TERM HUP
        used=0
        while time=$(ps -o cputimes= -p $pid | tr -d ' ') && [ -n "$time" ]; do
            used=$time
            sleep 1
        done
        if wait $pid; then
            error=$(tail -n 1 "$run/log.csv" | cut -d, -f5,6)
        else
            echo "$name, $trial: $(tail -n 1 "$run.log")" >&2
            # A trial that diverges has no scores, and the others go on.
            grep -q "finite" "$run.log" || exit 1
            error=,
        fi
        echo "$name,$trial,$lr,$patch,$batch,$tint,$steps,$used,$error" >>"$table"
    done
done
