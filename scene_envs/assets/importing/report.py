"""Reports on the import of assets: one line per asset."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class AssetReport:
    """Import report of one file.

    Attributes:
        name: Name of the asset.
        file: File that the asset was read from.
        mass: Mass, kg; 0 for welded assets.
        density: Density of the solid, kg/m^3; 0 for welded assets.
        parts: Number of fine convex parts.
        origin: Position (x, y, z) of the origin of the file in the asset frame, m.
        notes: Assumptions and choices.
        warnings: Faults of the file, corrected where possible.
        error: Reason why there is no asset; empty when there is one.
    """

    name: str
    file: Path
    mass: float = 0.0
    density: float = 0.0
    parts: int = 0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    error: str = ""

    def __str__(self) -> str:
        if self.error:
            return f"{self.name}: not imported: {self.error}"
        weight = f"{self.mass:.4g} kg" if self.mass > 0 else "welded"
        pieces = f"{self.parts} convex part{'s' if self.parts != 1 else ''}"
        return "; ".join([f"{self.name}: {self.file.name}, {weight}, {pieces}", *self.warnings, *self.notes])


@dataclass(frozen=True)
class ImportReport:
    """Import report of a folder.

    Attributes:
        folder: Folder that was read.
        assets: One report per file.
        notes: Notes about the folder as a whole.
    """

    folder: Path
    assets: tuple[AssetReport, ...]
    notes: tuple[str, ...] = ()

    def __getitem__(self, name: str) -> AssetReport:
        """The report of the asset called ``name``; KeyError without one."""
        for report in self.assets:
            if report.name == name:
                return report
        raise KeyError(name)

    def __str__(self) -> str:
        return "\n".join([f"{self.folder}: {len(self.assets)} assets", *self.notes, *map(str, self.assets)])
