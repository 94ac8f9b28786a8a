# shellcheck shell=sh disable=SC2034 # its variables are for the scripts that read it
# How the paper's networks and the learned rivals are trained; train.sh and trials.sh read this.

methods="demc demc-nofusion semc kpcn kpcn-combined lbf"

# Sets what was found best for a method in short trials (README.md), and `rate`, its steps in 100 seconds, at widths for
# hours of training; `semc` gets those at which it is as large. demc-paper is `demc` at the widths of the paper.
recipe() {
    model=$1 optimizer=muon widths=32,64,64,96,96 loss=relmse lr=5e-3 decay=0.5 leak=0.01 patch=64 batch=8 tint=0.25
    case $1 in
        demc) rate=345 ;;
        demc-nofusion) rate=400 ;;
        semc) rate=290 ;;
        demc-paper) model=demc optimizer=adam widths=64,128,256,512,512 rate=69 lr=1e-4 decay=0 leak=0 batch=4 ;;
        # In two streams it takes light passes; of Combined alone, any frame.
        kpcn) widths=64 rate=111 loss=smape lr=2e-3 decay=0.1 leak=0 patch=32 ;;
        kpcn-combined) widths=64 rate=215 loss=smape lr=2e-3 decay=0.1 leak=0 patch=32 ;;
        lbf) widths=10 rate=350 loss=both lr=3e-2 decay=0.1 leak=0 patch=128 batch=1 ;;
        *) echo "no recipe for $1" >&2; exit 2 ;;
    esac
}

# Prints the options of `demc train` for the method whose recipe is set, and a number of steps. Another SEED in the
# environment begins with other weights and draws other crops; RAW=1 is for references that were cleaned.
options() {
    # Weights are averaged over the last 20th of the steps.
    average=$(awk "BEGIN { print ($1 > 20 ? 1 - 20 / $1 : 0) }")
    last=$(awk "BEGIN { print $lr / 100 }")
    echo "--model $model --widths $widths --steps $1 --average $average --lr $lr:$last --loss $loss --patch $patch" \
        "--batch $batch --tint $tint --optimizer $optimizer --weight-decay $decay --leak $leak" \
        "--seed ${SEED:-1} ${RAW:+--raw-references}"
}
