"""The page of control charts: what moved on which robot and when, with a small chart of each robot that changed."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gtsam_rwhec.files.terminal_text import shown
from gtsam_rwhec.files.whole_files import checked_path
from gtsam_rwhec.fleet.watch_events import AlarmEvent, day_text
from gtsam_rwhec.fleet.watch_words import remarks, verdict
from gtsam_rwhec.fleet.watching import DAY_NS, RobotChart, Watched
from gtsam_rwhec.report.figures import INK, shortened, svg_figure
from gtsam_rwhec.report.html_page import write_page
from gtsam_rwhec.report.report_blocks import Block, Chart, Listing, Page, Paragraph, Section, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Robots with a chart; of more, the rest is in the table.
MOST_CHARTS = 24
#: Colours that are seen on dark as well as on light.
BLUE, VERMILLION = "#2C8CC9", "#D55E00"
#: Chances below are drawn here.
LEAST_CHANCE = 1e-16
MADE_BY = "Written by gtsam-rwhec fleet watch."


def write_watch_page(watched: Watched, path: str | Path, since_ns: int = 0) -> None:
    """Write the charts as one HTML file that needs no network.

    Parameters
    ----------
    watched : Watched
    path : str or Path
        An existing file is replaced.
    since_ns : int
        Only robots with an alarm from then on are shown.

    Raises
    ------
    FileFormatError
        The file cannot be written.
    """
    write_page(watch_page(watched, since_ns), checked_path(path))


def watch_page(watched: Watched, since_ns: int = 0) -> Page:
    """The page."""
    alarms = [alarm for alarm in reversed(watched.alarms) if alarm.when_ns >= since_ns]
    first: list[Block] = [
        Paragraph(verdict(watched, since_ns), "bad" if alarms else "good" if watched.robots else "care"),
        *(Paragraph(remark) for remark in remarks(watched)[:1]),
    ]
    kept = remarks(watched)[1:]
    charts = drift_charts(watched, since_ns)
    return Page(
        title="Drift of a fleet",
        tone="bad" if alarms else "good" if watched.robots else "care",
        sections=(
            Section("verdict", "The verdict", tuple(first)),
            *([Section("alarms", "What moved", (alarm_table(alarms),))] if alarms else []),
            *([Section("charts", "Control charts", charts)] if charts else []),
            *([Section("remarks", "Keep in mind", (Listing(kept),))] if kept else []),
        ),
        made_by=MADE_BY,
    )


def alarm_table(alarms: list[AlarmEvent]) -> Table:
    """A row for each alarm."""
    rows = tuple(
        (
            shown(alarm.robot),
            day_text(alarm.first_changed_ns),
            day_text(alarm.when_ns),
            "all frames" if alarm.is_of_all else ", ".join(shown(frame.name) for frame in alarm.frames),
            "; ".join(map(str, alarm.frames)),
            alarm.kind + (", back where it was" if alarm.is_back else ""),
        )
        for alarm in alarms
    )
    headings = ("robot", "first changed night", "seen on", "what moved", "by how much", "how")
    return Table(
        "Alarms, the last one first", headings, rows, sorts=True,
        legend="A step or a drift: which fits better; with one or two nights after a change neither does.",
    )  # fmt: skip


def drift_charts(watched: Watched, since_ns: int = 0) -> tuple[Block, ...]:
    """Small multiples of the robots that changed, the last one first."""
    names = list(dict.fromkeys(alarm.robot for alarm in reversed(watched.alarms) if alarm.when_ns >= since_ns))
    charts: list[Block] = []
    if names:
        charts.append(
            Paragraph(
                "Above: how unlikely each night is if nothing moved since the last change (one in so many nights, "
                "times the moments that are searched); an alarm is above the dashed line. Below: how far the frame "
                "that moved is from where it was before the last change, in mm. Vertical lines are dates of changes."
            )
        )
    for number, name in enumerate(names[:MOST_CHARTS]):
        charts.append(_chart(number, name, watched.robots[name]))
    if len(names) > MOST_CHARTS:
        charts.append(Paragraph(f"{len(names) - MOST_CHARTS} more robots changed: see the table.", "note"))
    return tuple(charts)


def _chart(number: int, name: str, robot: RobotChart) -> Chart:
    alarm = robot.alarms[-1]
    frame = alarm.frames[0].name
    days = np.array([(when - robot.when_ns[0]) / DAY_NS for when in robot.when_ns])
    moved = _millimetres(robot, frame, alarm)
    odds = np.array([1.0 / max(test.chance, LEAST_CHANCE) for test in robot.tests])
    limits = np.array([1.0 / test.limit if test.limit > 0.0 else math.nan for test in robot.tests])
    alarmed = np.isin(robot.when_ns, [each.when_ns for each in robot.alarms])
    changes = [(each.first_changed_ns - robot.when_ns[0]) / DAY_NS for each in robot.alarms]

    def draw(figure: Figure) -> None:
        panels = figure.subplots(2, 1, sharex=True)
        panels[0].plot(days, odds, "o-", color=BLUE, markersize=2.5, linewidth=0.8)
        panels[0].plot(days[alarmed], odds[alarmed], "D", color=VERMILLION, markersize=5)
        panels[0].plot(days, limits, "--", color=INK, linewidth=0.8)
        panels[0].set_yscale("log")
        powers = np.arange(0, int(math.log10(odds.max())) + 2, 2 if odds.max() < 1e8 else 4)
        panels[0].set_yticks(10.0**powers, [f"{10**power:,}" if power < 6 else f"1e{power}" for power in powers])
        panels[0].minorticks_off()
        panels[0].set_ylabel("one in")
        _signs(panels[1], days, moved, alarmed)
        panels[1].set_ylabel(f"{shortened(frame, 14)} (mm)")
        panels[1].set_xlabel(f"days since {day_text(robot.when_ns[0])}")
        for axes in panels:
            for change in changes:
                axes.axvline(change - 0.5, color=VERMILLION, linewidth=1.0)

    return Chart(name=f"drift-{number}", title=shown(name), says=str(alarm), svg=svg_figure(draw, 3.4))


def _signs(axes: Axes, days: np.ndarray, moved: np.ndarray, alarmed: np.ndarray) -> None:
    axes.plot(days, moved, "o", color=BLUE, markersize=2.5)
    axes.plot(days[alarmed], moved[alarmed], "D", color=VERMILLION, markersize=5)
    axes.set_ylim(bottom=0.0)


def _millimetres(robot: RobotChart, frame: str, alarm: AlarmEvent) -> np.ndarray:
    """How far a frame is from where it was before the last change, of each night; nan where a night does not say it."""
    own = np.stack([x[robot.frames.groups[frame]] for x in robot.x])
    known = np.asarray(np.isfinite(own).all(axis=1))
    earlier = [each.first_changed_ns for each in robot.alarms[:-1]]
    when = np.array(robot.when_ns)
    before = known & (when < alarm.first_changed_ns) & (when >= max(earlier, default=0))
    mean = own[before if bool(before.any()) else known].mean(axis=0)
    return np.array(
        [
            robot.frames.movement(frame, mean, each - mean).translation_mm if there else math.nan
            for each, there in zip(own, known, strict=True)
        ]
    )
