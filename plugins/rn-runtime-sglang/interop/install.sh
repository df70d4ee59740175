#!/bin/sh
# Installs SGLang 0.5.23 in an environment of its own, for the CPU where there is no GPU, and this package next to it.
#   install.sh DIRECTORY [PYTHON]
# With a GPU nothing is patched: SGLang and its requirements are installed as they are (about 10 GB).
set -eu
venv=$1
python=${2:-python3.11}
here=$(CDPATH= cd -- "$(dirname -- "$0")" && pwd)
root=$(CDPATH= cd -- "$here/../../.." && pwd)

[ -x "$venv/bin/python" ] || "$python" -m venv "$venv"
pip() { "$venv/bin/python" -m pip install --quiet --disable-pip-version-check "$@"; }

if command -v nvidia-smi >/dev/null 2>&1; then
  pip "sglang==0.5.23"
  pip lazy-loader simplejpeg
else
  # torch first and by itself: with anything else on the line pip may pick a build with gigabytes of CUDA packages.
  pip torch==2.13.0
  pip --constraint "$here/constraints.txt" torchvision transformers
  pip --no-deps sglang==0.5.23
  pip --constraint "$here/constraints.txt" --requirement "$here/requirements.txt"
  site=$("$venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
  # Step 1: torchvision comes built for CUDA; its library cannot be loaded beside a CPU torch, so the operators that it
  # would describe do not exist. Only the descriptions are taken out; images are not decoded by it.
  sed -i 's/^@torch.library.register_fake("torchvision::/# &/' "$site/torchvision/_meta_registrations.py"
  # Step 2: SGLang imports its CUDA kernels by name even on a CPU; a package with names and no kernels stands in.
  cp -r "$here/sgl_kernel" "$site/"
fi
pip hatchling editables
pip --no-deps --no-build-isolation \
  --editable "$root/roboneuron-core" --editable "$root/plugins/rn-vla" --editable "$root/plugins/rn-runtime-sglang"
"$venv/bin/python" -c 'import importlib.metadata as m; print("installed: SGLang", m.version("sglang"))'
