#!/usr/bin/env bash
# PyBullet 3.2.7: every body is braked by 0.04 v (1 + v) unless told otherwise: by 4.4 m/s^2 at 10 m/s, by 0.08 m/s^2 at 1 m/s, and turns likewise (1.2 rad/s^2 at 5 rad/s). A rig at 10 m/s has 6.9 m/s
# after a second. `linearDamping` and `angularDamping` of `changeDynamics` are the 0.04.
# Guessed: a free body obeys Newton, or, knowing of the default ("linear damping of the link (0.04 by default)"), loses 4 % of its velocity a second.
# Matters here: flights and throws simulated for a VIO, and their IMU, obey no given force: readings computed from the motion contain a drag that grows with the square of the velocity, 45 % of g at 10
# m/s, and along the motion. A test at 1 m/s shows 0.08 m/s^2. Set both to 0.
# Source: https://github.com/bulletphysics/bullet3, src/BulletDynamics/Featherstone/btMultiBody.cpp (DAMPING_K1_LINEAR, DAMPING_K2_LINEAR); this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --no-compile --target "$folder/packages" pybullet==3.2.7
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import math
from importlib.metadata import version

import pybullet

STEPS = 240  # of the default 1/240 s


def after_a_second(velocity, turn, **damping):
    """Return velocities (m/s) and turns (rad/s) along x and about z of a free box without gravity: after one step, and after a second."""
    pybullet.resetSimulation()
    shape = pybullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=0.1)
    body = pybullet.createMultiBody(1.0, shape, basePosition=[0, 0, 100])
    if damping:
        pybullet.changeDynamics(body, -1, **damping)
    pybullet.resetBaseVelocity(body, [velocity, 0, 0], [0, 0, turn])
    found = []
    for _ in range(STEPS):
        pybullet.stepSimulation()
        linear, angular = pybullet.getBaseVelocity(body)
        found.append((linear[0], angular[2]))
    return found[0], found[-1]


print("PyBullet", version("pybullet"))
pybullet.connect(pybullet.DIRECT)
for velocity, turn in ((1.0, 0.5), (10.0, 5.0), (20.0, 10.0)):
    first, last = after_a_second(velocity, turn)
    brake, spin = (velocity - first[0]) * STEPS, (turn - first[1]) * STEPS
    # of dv/dt = -0.04 v (1 + v): v / (1 + v) falls by exp(-0.04 t)
    ratio = math.exp(-0.04) * velocity / (1 + velocity)
    law = ratio / (1 - ratio)
    print(f"{velocity} m/s, {turn} rad/s: braked by {brake:.3f} m/s^2 and {spin:.3f} rad/s^2; after 1 s {last[0]:.3f} m/s, {last[1]:.3f} rad/s;",
          f"4 % would leave {velocity * math.exp(-0.04):.3f} m/s")
    assert abs(brake / (0.04 * velocity * (1 + velocity)) - 1) < 0.01 and abs(spin / (0.04 * turn * (1 + turn)) - 1) < 0.01
    assert abs(last[0] - law) < 0.02 * law
    assert after_a_second(velocity, turn, linearDamping=0, angularDamping=0)[1] == (velocity, turn)
PYTHON
