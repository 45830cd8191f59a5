#!/usr/bin/env bash
# Install a wheel into an empty environment outside the checkout, and use it as a new user would: plan a mission, evaluate the
# shipped pair against a heuristic, train for a few steps.
#
#   scripts/try_wheel.sh PYTHON WHEEL [ENVIRONMENT]
#
# ENVIRONMENT is an existing environment to use instead of an empty one; the wheel replaces the version that is in it.
set -euo pipefail
python=$1
wheel=$(realpath "$2")
here=$(realpath "$(dirname "${BASH_SOURCE[0]}")/..")
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT

environment=${3:-$scratch/environment}
if [ ! -x "$environment/bin/python" ]; then
    "$python" -m venv "$environment"
    "$environment/bin/python" -m pip install --quiet -c "$here/constraints.txt" torch
fi
"$environment/bin/python" -m pip install --quiet --force-reinstall --no-deps "$wheel"
"$environment/bin/python" -m pip install --quiet -c "$here/constraints.txt" "$wheel[all]"
"$environment/bin/python" -m pip check
cp "$here/examples/missions/orchard.csv" "$scratch"
cd "$scratch"

command=$environment/bin/sb3-uav
"$environment/bin/python" -c "import sb3_uav; print('sb3_uav', sb3_uav.__version__, 'from', sb3_uav.__file__)"
"$command" solve orchard.csv --uavs 2 --endurance 18min --speed 8m/s --reserve 20 --time-limit 2 -o orchard
"$environment/bin/python" - <<'PYTHON'
import numpy as np
from sb3_uav.envs import Instances

rng = np.random.default_rng(0)
Instances.from_arrays(rng.random((4, 2)), rng.random((4, 20, 2)), max_distance=2.0, n_uavs=2).save("some.npz")
PYTHON
"$command" evaluate --instances some.npz --solvers dl-drl kmeans-nearest --out results
"$command" train --algo reinforce --env TaskAllocation-U3-N20-v0 -n 2000 --log-folder logs
for file in orchard/routes.csv orchard/map.html results/results.csv logs/reinforce/TaskAllocation-U3-N20-v0_1/router.zip; do
    test -s "$file" || { echo "no $file was written" >&2; exit 1; }
done
echo "the wheel works on $("$environment/bin/python" --version)"
