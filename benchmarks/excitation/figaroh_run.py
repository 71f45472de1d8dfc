"""One exciting trajectory by FIGAROH, in its own interpreter; called by `run.py --figaroh-python`.

    python figaroh_run.py URDF OUTPUT.npz SEED VELOCITIES

Cubic splines through 7 waypoints, 2 s apart, two segments stacked (24 s), condition number of the rigid base
regressor by IPOPT, limits in position, velocity and effort, no collision: the package's own way with its own
defaults.
"""

from __future__ import annotations

import re
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import yaml

WAYPOINTS, SEGMENT_S, RATE_HZ, REPEATS = 7, 2.0, 20, 2


def main() -> None:
    urdf, output, seed, velocities = sys.argv[1:5]
    import pinocchio as pin
    from figaroh.optimal.base_optimal_trajectory import BaseOptimalTrajectory, BaseTrajectoryIPOPTProblem
    from figaroh.tools.robot import Robot

    class Planner(BaseOptimalTrajectory):  # type: ignore[misc]
        def create_ipopt_problem(self, *args: Any) -> Any:
            return BaseTrajectoryIPOPTProblem(self, *args)

    # the package counts touching neighbours as collisions; without shapes it plans without avoidance
    bare = re.sub(r"<collision>.*?</collision>", "", Path(urdf).read_text(encoding="utf-8"), flags=re.S)
    with tempfile.NamedTemporaryFile("w", suffix=".urdf", delete=False) as shapes:
        shapes.write(bare)
    robot = Robot(shapes.name, package_dirs=str(Path(urdf).parent))
    speeds = np.array([float(word) for word in velocities.split(",")])
    robot.model.velocityLimit = speeds
    joints = [str(name) for name in robot.model.names][1:]
    config = {
        "robot": {"name": "lwr4plus"},
        "tasks": {
            "identification": {
                "type": "identification",
                "joints": {"active_joints": joints},
                "problem": {
                    "model_components": {"friction": False, "actuator_inertia": False, "joint_offset": False}
                },
                "mechanics": {"reduction_ratios": [1.0] * 7},
                "coupling": {"has_coupled_wrist": False},
            },
            "optimal_trajectory": {
                "type": "optimal_trajectory",
                "trajectory": {"waypoints": WAYPOINTS, "frequency": RATE_HZ, "segment_duration": SEGMENT_S},
            },
        },
    }
    with tempfile.NamedTemporaryFile("w", suffix=".yaml", delete=False) as handle:
        yaml.safe_dump(config, handle)
    np.random.seed(int(seed))  # noqa: NPY002 - the package draws from the global generator
    begun = time.process_time()

    planner = Planner(robot, joints, handle.name)
    planner.identif_config.update(act_idxq=list(range(7)), act_idxv=list(range(7)))
    planner.initialize()
    results = planner.solve(stack_reps=REPEATS)
    seconds = time.process_time() - begun
    np.savez(
        output,
        q=np.vstack(results["P_F"]),
        qd=np.vstack(results["V_F"]),
        qdd=np.vstack(results["A_F"]),
        cpu_s=seconds,
        pinocchio=pin.__version__,
    )


if __name__ == "__main__":
    main()
