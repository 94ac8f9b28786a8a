# shellcheck shell=sh disable=SC2034 # its variables are for the scripts that read it
# How the paper's networks and the learned rivals are trained; train.sh and trials.sh read this.

methods="demc demc-nofusion semc kpcn lbf"

# Sets what was found best for a method in short trials (README.md), and `rate`, its steps in 100 seconds.
recipe() {
    tint=0.25 decay=0.1 leak=0
    case $1 in
        demc) rate=900 loss=relmse lr=5e-3 decay=0.2 leak=0.01 patch=64 batch=8 ;;
        demc-nofusion) rate=1050 loss=relmse lr=5e-3 decay=0.5 leak=0.01 patch=64 batch=8 ;;
        semc) rate=720 loss=relmse lr=5e-3 decay=0.2 leak=0.01 patch=64 batch=8 ;;
        kpcn) rate=250 loss=smape lr=2e-3 patch=32 batch=8 ;;
        lbf) rate=350 loss=both lr=3e-2 patch=128 batch=1 ;;
        *) echo "no recipe for $1" >&2; exit 2 ;;
    esac
}

# Prints the options of `demc train` for a method, whose recipe is set, and a number of steps.
options() {
    awk -v name="$1" -v steps="$2" -v tint="$tint" -v loss="$loss" -v lr="$lr" -v decay="$decay" \
        -v leak="$leak" -v patch="$patch" -v batch="$batch" \
        'BEGIN {
            average = steps > 20 ? 1 - 20 / steps : 0
            printf "--model %s --steps %d --average %g --lr %g:%g ", name, steps, average, lr, lr / 100
            printf "--loss %s --patch %d --batch %d --tint %g ", loss, patch, batch, tint
            printf "--optimizer muon --weight-decay %g --leak %g --seed 1\n", decay, leak
        }'
}
