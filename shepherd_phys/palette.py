"""The colours of a picture: light and dark."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Theme:
    """The colours of a picture, as ``#rrggbb``."""

    ground: str
    grid: tuple[str, str]
    """Of the fine lines and of the others."""
    goal: str
    goal_ring: str
    obstacle: str
    ink: str
    faint_ink: str
    sheep: tuple[str, str, str, str]
    """Wild and grazing, wild and threatened, arrived and grazing, arrived and threatened."""
    sheep_face: str
    shepherds: tuple[str, ...]
    """One for each shepherd, from the first again after the last."""
    shepherd_edge: str
    beams: dict[str, str]
    """Of the lidar's beams, by the channel."""
    earning: str
    """Of beams that earn reward."""

    def shepherd(self, index: int) -> str:
        """The identity colour of a shepherd."""
        return self.shepherds[index % len(self.shepherds)]


THEMES = {
    "light": Theme(
        ground="#F7F6F2",
        grid=("#F0EEE8", "#E3E0D7"),
        goal="#D3EBD0",
        goal_ring="#5BA567",
        obstacle="#5A6270",
        ink="#2B303A",
        faint_ink="#757A85",
        sheep=("#FFFDF5", "#FFA62B", "#C3ECF5", "#2BA3B8"),
        sheep_face="#343941",
        shepherds=("#2663BF", "#E62E2E", "#9900FF", "#260F26", "#FF6685", "#4C0F00", "#1F0099", "#993D74"),
        shepherd_edge="#FFFFFF",
        beams={"sheep": "#E08A00", "shepherds": "#7A5CC9", "goal": "#5BA567", "obstacles": "#7C8594"},
        earning="#D6006E",
    ),
    "dark": Theme(
        ground="#14181F",
        grid=("#1A1F28", "#262D39"),
        goal="#1C3D2B",
        goal_ring="#4FBF73",
        obstacle="#586271",
        ink="#E8EAEE",
        faint_ink="#8F98A6",
        sheep=("#F1ECE0", "#FFB347", "#B4E6EF", "#2AA5BC"),
        sheep_face="#0B0E13",
        shepherds=("#0099FF", "#FF5C33", "#CCFF00", "#8533FF", "#33FFAD", "#8C8C8C", "#BF00BF", "#BF634D"),
        shepherd_edge="#FFFFFF",
        beams={"sheep": "#FFB347", "shepherds": "#A58BFF", "goal": "#4FBF73", "obstacles": "#8793A5"},
        earning="#FF4FA3",
    ),
}
"""Made for the colour-blind, too: shepherds lie 21 or more apart in CIE Lab under protanopia, deuteranopia and
tritanopia (Machado et al. 2009); wild sheep are warm, arrived ones cold."""
