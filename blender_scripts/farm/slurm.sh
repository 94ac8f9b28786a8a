#!/usr/bin/env bash
# Splits a list of frames (or seeds) into chunks and runs a command on each as one task of a Slurm array.
#
#   slurm.sh --frames 1-240 --chunk 10 --logs logs -- \
#       demc denoise renders --out clean --frames {frames} --json
#
# In the command {frames} becomes the task's frames (1,2,3), {first} the first of them, {after} the last plus
# one, {task} the task's number (0007). --frames takes 7, 1-9, 1-9:4 and lists of them. --sbatch 'OPTIONS'
# adds options of sbatch: --sbatch '--partition=cpu --cpus-per-task=8 --time=2:00:00'.
#
# What a task prints goes to LOGS/<task>.out and LOGS/<task>.err. A task that was killed (kill -9, out of
# memory) or comes near its time limit is put back into the queue, up to three times: demc and the Blender
# scripts go on where they stopped. A task whose command fails by itself stays failed.
set -euo pipefail

readonly MOST_RESTARTS=3

fail() {
    echo "slurm.sh: $1" >&2
    exit 2
}

# Prints the frames of a list, one a line.
expand() {
    local part pattern='^(-?[0-9]+)(-(-?[0-9]+))?([:x]([0-9]+))?$'
    local -a parts
    IFS=, read -ra parts <<< "$1"
    for part in "${parts[@]}"; do
        [[ $part =~ $pattern ]] || fail "'$part' is no list of frames; write 7, 1-9, 1-9:4 or 1,3,7-9"
        local first=$((10#${BASH_REMATCH[1]#-})) last step=${BASH_REMATCH[5]:-1}
        [[ ${BASH_REMATCH[1]} == -* ]] && first=-$first
        last=$first
        if [[ -n ${BASH_REMATCH[3]} ]]; then
            last=$((10#${BASH_REMATCH[3]#-}))
            [[ ${BASH_REMATCH[3]} == -* ]] && last=-$last
        fi
        ((step > 0 && last >= first)) || fail "'$part' holds no frame"
        seq "$first" "$step" "$last"
    done
}

frames='' chunk=1 logs=logs sbatch_options=''
original=("$@")
while (($#)); do
    case $1 in
        --frames=*) frames=${1#*=} && shift ;;
        --frames | --chunk | --logs | --sbatch)
            (($# > 1)) || fail "$1 wants a value"
            case $1 in
                --frames) frames=$2 ;;
                --chunk) chunk=$2 ;;
                --logs) logs=$2 ;;
                --sbatch) sbatch_options=$2 ;;
            esac
            shift 2
            ;;
        --) shift && break ;;
        *) fail "what is '$1'? Usage: slurm.sh --frames LIST [--chunk N] [--logs DIR] [--sbatch OPTIONS] -- COMMAND" ;;
    esac
done
[[ -n $frames ]] || fail "--frames is missing: which frames to split, for example 1-240"
[[ $chunk =~ ^[1-9][0-9]*$ ]] || fail "--chunk $chunk is not a number of at least 1"
(($#)) || fail "no command: write it after --"
listed=$(expand "$frames")
mapfile -t all <<< "$listed"

if [[ -z ${SLURM_ARRAY_TASK_ID:-} ]]; then
    mkdir -p "$logs"
    tasks=$(((${#all[@]} + chunk - 1) / chunk))
    # The options are words of their own.
    # shellcheck disable=SC2086
    job=$(sbatch --parsable --array="0-$((tasks - 1))" --requeue --open-mode=append --signal=B:USR1@60 \
        --job-name=demc --output="$logs/%4a.out" --error="$logs/%4a.err" $sbatch_options "$0" "${original[@]}")
    echo "job $job: ${#all[@]} frames in $tasks tasks; logs in $logs"
    exit
fi

mine=("${all[@]:SLURM_ARRAY_TASK_ID * chunk:chunk}")
((${#mine[@]})) || fail "task $SLURM_ARRAY_TASK_ID has no frames; unset SLURM_ARRAY_TASK_ID to submit"
joined=$(IFS=, && echo "${mine[*]}")
command=()
for word in "$@"; do
    word=${word//'{frames}'/$joined}
    word=${word//'{first}'/${mine[0]}}
    word=${word//'{after}'/$((mine[-1] + 1))}
    command+=("${word//'{task}'/$(printf %04d "$SLURM_ARRAY_TASK_ID")}")
done

out_of_time=''
"${command[@]}" &
child=$!
# demc finishes the file it is writing, and goes on from there the next time.
trap 'out_of_time=1; kill -TERM "$child" 2> /dev/null || true' USR1
status=0
wait "$child" || status=$?
if [[ -n $out_of_time ]]; then # that `wait` ended with the signal, not with the child
    wait "$child" || status=$?
fi
if { ((status == 137)) || [[ -n $out_of_time && $status -ne 0 ]]; } && ((${SLURM_RESTART_COUNT:-0} < MOST_RESTARTS)); then
    echo "slurm.sh: stopped with status $status; back into the queue" >&2
    scontrol requeue "${SLURM_ARRAY_JOB_ID}_$SLURM_ARRAY_TASK_ID"
    sleep 60 # until Slurm takes this task down
fi
exit "$status"
