"""Step every environment that comes with the package, and print what came of it as JSON.

For an installed package: ``python -I tests/tools/step_every_env.py [--native]``. With
``--native`` it fails where the C extension is missing.
"""

import json
import sys

import gymnasium

import fmugym
from fmugym.fmi.bundled import FMI_VERSIONS

if "--native" in sys.argv:
    import fmugym._native

steps = []
own = {name for name in gymnasium.registry if name.startswith("fmugym/")}
for env_id in sorted(own - {"fmugym/FMU-v0"}):  # which needs a task
    for fmi_version in FMI_VERSIONS[env_id == "fmugym/House-v0" :]:  # not for FMI 1.0
        env = gymnasium.make(env_id, fmi_version=fmi_version)
        env.reset(seed=0)
        observation, *_ = env.step(env.action_space.sample())
        steps.append([env_id, fmi_version, env.observation_space.contains(observation)])
        env.close()
print(json.dumps({"file": fmugym.__file__, "steps": steps}))
