"""``scene-envs verify``."""

from __future__ import annotations

from dataclasses import dataclass

from scene_envs.errors import PhysicsError

WRITES = False
POSITIONAL = ("path",)


@dataclass
class VerifyConfig:
    """Exported scenes, judged by every engine and simulator that is installed.

    Attributes:
        path: folder of an export, or of a run that holds one in export/. It gets verify.json and verify.txt.
    """

    path: str = "."


def run(settings: VerifyConfig) -> None:
    """Print the verdicts; raises PhysicsError when a judge finds a scene that is not ready."""
    from scene_envs.export import verify

    report = verify(settings.path)
    print(report, flush=True)
    if not all(report.ready):
        raise PhysicsError(f"{report.ready.count(False)} of {len(report.scenes)} scenes are not ready for all judges")
