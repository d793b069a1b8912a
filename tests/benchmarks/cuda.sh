#!/bin/sh
# The whole CUDA check, at most 8 minutes: bash tests/benchmarks/cuda.sh
# A machine without TorchRL takes it from wheels in $WHEELS (.whl beside the repository by default); torch is its own.
# DEVICE=cpu rehearses it on a machine without a GPU.
set -eu
cd "$(dirname "$0")/../.."
python=${PYTHON:-python3}
wheels=${WHEELS:-.whl}
if ! "$python" -c "import torchrl, tensordict, gymnasium, tyro" 2>/dev/null; then
    [ -d "$wheels" ] || { echo "TorchRL is not installed and $wheels has no wheels: pip download them first" >&2; exit 2; }
    site=$(mktemp -d)
    trap 'rm -rf "$site"' EXIT
    "$python" -m pip install --quiet --no-index --no-deps --target "$site" "$wheels"/*.whl
    PYTHONPATH=$site
fi
PYTHONPATH=$PWD:${PYTHONPATH:-}
export PYTHONPATH
timeout 470 "$python" tests/benchmarks/cuda_check.py --device "${DEVICE:-cuda}" "$@"
