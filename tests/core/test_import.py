"""Importing the package registers environments and loads nothing heavy."""

from __future__ import annotations

import subprocess
import sys


def test_import_is_light_and_registers() -> None:
    code = (
        "import sys, gymnasium, scene_envs; "
        "assert 'SceneEnvs/Denoising-v0' in gymnasium.registry and 'SceneEnvs/Search-v0' in gymnasium.registry; "
        "heavy = {'torch', 'pybullet', 'fcl', 'trimesh', 'torchrl', 'rewards', 'agents'} & set(sys.modules); "
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
