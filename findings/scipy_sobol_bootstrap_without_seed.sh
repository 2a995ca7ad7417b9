#!/usr/bin/env bash
# scipy.stats.sobol_indices(rng=0) is reproducible, the confidence intervals of its bootstrap() are not.
#
# Versions: scipy 1.17.1, numpy 2.4.6. Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: the rng given to sobol_indices decides everything that follows, so result.bootstrap() gives the same
# intervals each time.
# Behaviour: the indices are equal; bootstrap() has no rng argument and draws its resamples from fresh entropy, so two
# calls on one result, and two runs of one script, give different intervals.
# For a sensitivity study: an interval in a report cannot be repeated. Resample the stored evaluations yourself.
#
# Output seen:
seen=$(
    cat <<'SEEN'
first-order indices of two calls equal: True
intervals of two bootstraps equal: False
bootstrap accepts: confidence_level, n_resamples
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check scipy==1.17.1 numpy==2.4.6
now=$(
    venv/bin/python - <<'PROGRAM'
import inspect

import numpy as np
from scipy import stats


def indices():
    return stats.sobol_indices(func=lambda x: x[0] + 2.0 * x[1], n=64, dists=[stats.uniform(), stats.uniform()], rng=0)


one, two = indices(), indices()
print("first-order indices of two calls equal:", np.array_equal(one.first_order, two.first_order))
low, again = (one.bootstrap(n_resamples=100).first_order.confidence_interval.low for _ in range(2))
print("intervals of two bootstraps equal:", np.array_equal(low, again))
print("bootstrap accepts:", ", ".join(inspect.signature(one.bootstrap).parameters))
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
