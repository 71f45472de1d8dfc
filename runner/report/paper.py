"""Figures for papers, drawn by matplotlib: column widths and fonts of IEEE and IFAC, PDF, PGF, SVG and PNG.

matplotlib is imported by the functions that draw, never by this module.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from runner.report.plot import STYLES, Band, Line, Mark, Panel, Points, limits

Floats = NDArray[np.float64]

WIDTHS_MM: Mapping[str, float] = {"ieee": 88.9, "ieee-wide": 181.9, "ifac": 84.0, "ifac-wide": 173.0}
"""One column and the whole width of the text [mm]: IEEE transactions; `ifacconf`, two columns and their gap of 5 mm."""

SUFFIXES = (".pdf", ".pgf", ".svg", ".png")
JOINT_WORDS = ("numbers", "names")

_STYLE: Mapping[str, Any] = {
    "mathtext.fontset": "stix",
    "font.size": 8.0,
    "axes.titley": 1.0,  # above the axes, without a search for ticks there
    "axes.titlesize": 8.0,
    "axes.labelsize": 8.0,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "legend.fontsize": 7.0,
    "axes.titlelocation": "left",
    "axes.titlepad": 3.0,
    "axes.labelpad": 2.0,
    "axes.linewidth": 0.5,
    "axes.edgecolor": "#4d4d4d",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.5,
    "xtick.major.width": 0.5,
    "ytick.major.width": 0.5,
    "xtick.major.size": 2.0,
    "ytick.major.size": 2.0,
    "xtick.major.pad": 2.0,
    "ytick.major.pad": 2.0,
    "legend.frameon": False,
    "figure.dpi": 200.0,
    "savefig.dpi": 300.0,
    "figure.facecolor": "white",
    "pdf.fonttype": 42,
    "svg.hashsalt": "lwr-identification",
    "pgf.rcfonts": False,
}  # fmt: skip
FONTS = ("Times New Roman", "Times", "Nimbus Roman", "TeX Gyre Termes", "Liberation Serif", "STIXGeneral")
"""Times and its equals, the font of IEEE and IFAC; the last comes with matplotlib."""
_MM = 1.0 / 25.4
_PT_OF_PX = 0.6
_PANEL_MM = 42.0
"""Least width of a panel."""
_LOWER_SHARE = 0.4
_LINE_MM = 3.3
"""Height of a line of text."""
_LETTER_MM = 1.3
"""Width of a letter of a title."""
_PART_MM = 2.0
"""Gap between a panel and its lower part."""
_MARKERS = {"circle": "o", "cross": "x", "diamond": "D"}
_TEXTS = {"²": "$^2$", "τ": r"$\tau$", "±": r"$\pm$", "\N{NO-BREAK SPACE}": " "}
_LARGE = 20.0
"""Ratio of intervals beyond a linear axis."""


def width_mm(width: str | float) -> float:
    """Width [mm] by name of a journal's column, or as given; ConfigurationError beyond 30 to 400 mm."""
    if isinstance(width, str):
        if width not in WIDTHS_MM:
            raise ConfigurationError(
                f"figure: width {width!r} is unknown; choose {', '.join(WIDTHS_MM)} or a number of mm"
            )
        return WIDTHS_MM[width]
    if not 30.0 <= width <= 400.0:
        raise ConfigurationError(
            f"figure: width {width:g} mm is outside 30 to 400 mm; give the column's width"
        )
    return float(width)


def checked_target(path: str | Path) -> Path:
    """The path of a figure. ConfigurationError for another suffix than those of `SUFFIXES` or a missing folder."""
    target = Path(path)
    if target.suffix.lower() not in SUFFIXES:
        raise ConfigurationError(
            f"figure {target}: suffix {target.suffix or 'none'!r} is no format; end the name in "
            f"{', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}"
        )
    if not target.parent.is_dir():
        raise ConfigurationError(f"figure {target}: folder {target.parent} does not exist; make it first")
    return target


def joint_labels(names: Sequence[str], joints: str) -> tuple[str, ...]:
    """What joints are called: `names` as they are, or `numbers` 1 to n in kinematic order, as papers have them."""
    if joints not in JOINT_WORDS:
        raise ConfigurationError(f"figure: joints {joints!r} is unknown; choose numbers or names")
    return tuple(names) if joints == "names" else tuple(f"joint {k + 1}" for k in range(len(names)))


@contextmanager
def paper_style(font: str = "") -> Iterator[Any]:
    """The module matplotlib, with the style of the figures while the context is open. font : instead of Times."""
    try:
        import matplotlib
        from matplotlib import font_manager
    except ImportError as error:
        raise ConfigurationError(
            "figure: matplotlib is not installed; run `pip install 'matplotlib>=3.8,<4'`"
        ) from error
    here = set(font_manager.get_font_names())
    font = font or next((name for name in FONTS if name in here), "serif")
    style: Any = {**_STYLE, "font.family": font}
    with matplotlib.rc_context(style):
        yield matplotlib


def new_figure(width: float, height: float, *, shown: bool) -> Any:
    """An empty figure [mm]. shown : known to pyplot, as notebooks need it."""
    size = (width * _MM, height * _MM)
    if shown:
        from matplotlib import pyplot

        return pyplot.figure(figsize=size)
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size)
    FigureCanvasAgg(figure)
    return figure


def write_figure(figure: Any, path: str | Path, title: str, description: str = "") -> Path:
    """Write a matplotlib figure in the format of the suffix, the same file for the same figure.

    PGF needs no LaTeX on this computer; the text takes the fonts of the document that includes it, and an image goes to
    a PNG beside it.
    """
    target = checked_target(path)
    suffix = target.suffix.lower()
    metadata: dict[str, dict[str, Any]] = {
        ".pdf": {"Title": title, "Subject": description, "CreationDate": None},
        ".svg": {"Title": title, "Description": description, "Date": None},
        ".png": {"Title": title, "Description": description, "Software": None},
        ".pgf": {},
    }
    kind = {"format": suffix[1:], **({"metadata": metadata[suffix]} if metadata[suffix] else {})}
    with TemporaryDirectory(prefix=".", dir=target.parent) as drafts:
        with paper_style(), _without_latex() if suffix == ".pgf" else _plain():
            figure.savefig(Path(drafts) / target.name, **kind)
        # PGF refers to images in files of their own beside it.
        for draft in sorted(Path(drafts).iterdir(), key=lambda one: one.suffix == suffix):
            draft.replace(target.with_name(draft.name))
    return target


def draw_panels(
    panels: Sequence[Panel],
    width: str | float = "ieee-wide",
    *,
    font: str = "",
    columns: int | None = None,
    statistics: bool = False,
    shown: bool = False,
) -> NDArray[Any]:
    """The matplotlib axes of panels in one figure, (n,), or (n, 2) with lower parts (None where there is none).

    width : see `width_mm`. columns : panels side by side; by default as many as stay legible. font : instead of
    Times. statistics : the note of each panel in its title. shown : as in `new_figure`.
    """
    wide = width_mm(width)
    columns = max(1, min(columns or int(wide // _PANEL_MM), len(panels)))
    with paper_style(font):
        figure = new_figure(wide, 10.0, shown=shown)
        found = np.full((len(panels), 2), None, dtype=object)
        for index, panel in enumerate(panels):
            found[index] = _draw(figure, panel, statistics)
        _outer_labels(panels, found, columns)
        _place(figure, found, columns, wide)
    return found if any(panel.split for panel in panels) else found[:, 0]


def draw_matrix(
    names: Sequence[str],
    values: Floats,
    colours: Sequence[tuple[float, str]],
    width: str | float = "ieee-wide",
    *,
    shown: bool = False,
) -> Any:
    """The axes of a matrix (n, n) of values from -1 to 1 with the names of its rows."""
    wide = width_mm(width)
    with paper_style():
        from matplotlib.colors import LinearSegmentedColormap

        figure = new_figure(wide, 0.9 * wide, shown=shown)
        figure.set_layout_engine("constrained")
        axes = figure.add_subplot()
        colour_map = LinearSegmentedColormap.from_list("diverging", list(colours), 41)
        image = axes.imshow(values, cmap=colour_map, vmin=-1.0, vmax=1.0, interpolation="nearest")
        axes.grid(False)
        # Names fit a cell or are left out evenly.
        cell_pt = 0.76 * wide / max(len(names), 1) * _MM * 72.0
        step = max(1, math.ceil(3.6 / cell_pt))
        places = np.arange(0, len(names), step)
        shown_names = [names[k] for k in places.tolist()]
        size = min(7.0, max(3.4, 0.95 * cell_pt * step))
        axes.set_xticks(places, shown_names, rotation=90, fontsize=size)
        axes.set_yticks(places, shown_names, fontsize=size)
        axes.tick_params(length=0.0, pad=1.5)
        axes.xaxis.tick_top()
        bar = figure.colorbar(image, ax=axes, shrink=0.5, aspect=30, pad=0.01, ticks=[-1, -0.5, 0, 0.5, 1])
        bar.outline.set_linewidth(0.5)
        bar.set_label("correlation")
    return axes


def _draw(figure: Any, panel: Panel, statistics: bool) -> list[Any]:
    """The axes of a panel and of its lower part or None, not yet in their place."""
    upper = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    lower = figure.add_axes((0.0, 0.0, 1.0, 1.0), sharex=upper) if panel.split else None
    upper.tick_params(labelbottom=lower is None)
    note = f"\n{panel.note}" if statistics and panel.note else ""
    title = f"J{panel.title[1:]}" if panel.title.startswith("joint ") else panel.title
    upper.set_title(_text(title + note))
    span = (0.5, len(panel.x_names) + 0.5) if panel.x_names else limits([m.x for m in panel.marks], pad=0.0)
    for axes, label, low in ((upper, panel.y_label, False), (lower, panel.lower_label, True)):
        if axes is None:
            continue
        marks = [mark for mark in panel.marks if mark.lower == low]
        for mark in marks:
            _mark(axes, mark)
        axes.set_ylabel(_text(label.replace(" [", "\n[") if low else label), linespacing=0.95)
        _scale(axes, marks, log=low and panel.lower_log)
    bottom = upper if lower is None else lower
    bottom.set_xlabel(_text(panel.x_label))
    upper.set_xlim(*span)
    if panel.x_names:
        bottom.set_xticks(np.arange(1, len(panel.x_names) + 1), list(panel.x_names))
    else:
        upper.xaxis.set_major_locator(_locator(5))
    return [upper, lower]


def _locator(most: int) -> Any:
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(most, steps=[1, 2, 2.5, 5, 10], min_n_ticks=3)


def _scale(axes: Any, marks: Sequence[Mark], *, log: bool) -> None:
    halves = [
        0.5 * np.ptp(mark.interval, axis=1)
        for mark in marks
        if isinstance(mark, Points) and mark.interval is not None
    ]
    sizes = np.concatenate([*halves, np.zeros(0)])
    sizes = sizes[np.isfinite(sizes) & (sizes > 0.0)]
    pad = 0.12 if len(sizes) else 0.04
    ends = limits([part for mark in marks for part in _columns(mark)], pad=pad)
    farthest = max(abs(ends[0]), abs(ends[1]))
    if log and len(sizes) and farthest > _LARGE * sizes.min():
        # The smallest interval fills the linear part, so each is to be seen.
        least = 10.0 ** math.floor(math.log10(float(sizes.min())))
        largest = 10.0 ** math.floor(math.log10(farthest))
        axes.set_yscale("symlog", linthresh=least, linscale=0.5)
        axes.set_ylim(-1.6 * farthest, 1.6 * farthest)
        axes.set_yticks([-largest, 0.0, largest])
        axes.set_yticks([], minor=True)
        return
    axes.set_ylim(*ends)
    axes.yaxis.set_major_locator(_locator(3 if marks and marks[0].lower else 4))


def _columns(mark: Mark) -> list[Floats]:
    if isinstance(mark, Band):
        return [mark.low, mark.high]
    if isinstance(mark, Line) or mark.interval is None:
        return [mark.y]
    return [mark.y, mark.interval[:, 0], mark.interval[:, 1]]


def _mark(axes: Any, mark: Mark) -> None:
    style = STYLES[mark.role]
    label = _text(mark.label)
    if isinstance(mark, Band):
        axes.fill_between(
            mark.x, mark.low, mark.high, color=style.colour, alpha=0.55, linewidth=0.0, label=label
        )
        return
    width = _PT_OF_PX * style.width
    if isinstance(mark, Line):
        dash = [float(part) * _PT_OF_PX / width for part in style.dash.split()]
        line: Any = (0.0, dash) if dash else "-"
        axes.plot(mark.x, mark.y, color=style.colour, linewidth=width, linestyle=line, label=label)
        return
    hollow = {"markerfacecolor": "none"} if style.symbol == "diamond" else {}
    points = {"marker": _MARKERS[style.symbol], "markersize": 3.0, "markeredgewidth": 0.8, **hollow}
    if mark.interval is None:
        axes.plot(mark.x, mark.y, linestyle="none", color=style.colour, label=label, **points)
        return
    reach = np.abs(np.vstack([mark.y - mark.interval[:, 0], mark.interval[:, 1] - mark.y]))
    points["markersize"] = 2.2
    axes.errorbar(
        mark.x, mark.y, yerr=reach, fmt="none", ecolor=style.colour, elinewidth=0.9, capsize=2.2, capthick=0.9
    )
    axes.plot(mark.x, mark.y, linestyle="none", color=style.colour, label=label, **points)


def _outer_labels(panels: Sequence[Panel], found: NDArray[Any], columns: int) -> None:
    """Common labels of axes stay at the left and at the bottom of the figure only."""
    bottoms = [upper if lower is None else lower for upper, lower in found]
    if len({panel.x_label for panel in panels}) == 1:
        for axes in bottoms[: max(0, len(panels) - columns)]:
            axes.set_xlabel("")
    if len({(panel.y_label, panel.lower_label) for panel in panels}) == 1:
        for index, pair in enumerate(found):
            for axes in pair:
                if axes is not None and index % columns:
                    axes.set_ylabel("")


def _place(figure: Any, found: NDArray[Any], columns: int, width: float) -> None:
    """Put the axes side by side, of equal size, with room for their numbers, and the legend above them."""
    rows = math.ceil(len(found) / columns)
    room = [max(_left(axes) for pair in found[k::columns] for axes in pair if axes) for k in range(columns)]
    each = (width - sum(room) - 2.0 * columns) / columns
    lower = any(pair[1] is not None for pair in found)
    heights = np.array([min(max(0.62 * each, 20.0), 40.0)])
    heights = np.append(heights, [_PART_MM, _LOWER_SHARE * heights[0]]) if lower else heights
    below = [7.5 if any(_bottom(pair).get_xlabel() for pair in found[k * columns :][:columns]) else 4.0
             for k in range(rows)]  # fmt: skip
    head = 1.2 + _LINE_MM * max(1 + _title(pair[0]).count("\n") for pair in found)
    top = 4.0 * _legend(figure, width) + 0.5
    height = top + sum(below) + rows * (head + heights.sum())
    figure.set_size_inches(width * _MM, height * _MM)
    y = height - top
    for index, pair in enumerate(found):
        row, column = divmod(index, columns)
        if column == 0:
            y -= head + heights.sum() + (below[row - 1] if row else 0.0)
        x = sum(room[: column + 1]) + column * (each + 2.0)
        # A title too long for its panel is set smaller.
        needed = _LETTER_MM * max(map(len, _title(pair[0]).split("\n")))
        if needed > each:
            pair[0].set_title(_title(pair[0]), fontsize=max(4.5, 8.0 * each / needed))
        boxes = [(y, heights.sum())]
        if pair[1] is not None:
            boxes = [(y + heights[1:].sum(), heights[0]), (y, heights[2])]
        for axes, (low, tall) in zip(pair, boxes, strict=False):
            axes.set_position((x / width, low / height, each / width, tall / height))
            edge = _LINE_MM * (1 + axes.get_ylabel().count("\n")) - room[column]
            axes.yaxis.set_label_coords(edge, 0.5 * tall, transform=_from_corner(figure, axes))


def _title(axes: Any) -> str:
    return str(axes.get_title(loc="left"))


def _from_corner(figure: Any, axes: Any) -> Any:
    """Places [mm] from the lower left corner of the axes."""
    from matplotlib.transforms import Affine2D, ScaledTranslation

    box = axes.get_position()
    corner = ScaledTranslation(box.x0, box.y0, figure.transFigure)
    return Affine2D().scale(_MM) + figure.dpi_scale_trans + corner


def _bottom(pair: NDArray[Any]) -> Any:
    return pair[0] if pair[1] is None else pair[1]


def _left(axes: Any) -> float:
    """Room [mm] for the numbers and the label at the left of axes."""
    axis = axes.yaxis
    low, high = axes.get_ylim()
    inside = [value for value in axis.get_majorticklocs() if low <= value <= high]
    texts = axis.get_major_formatter().format_ticks(inside)
    longest = max((4 if "$" in text else len(text) for text in texts), default=1)
    label = axes.get_ylabel()
    digit = 1.25 if axes.yaxis.label.get_fontfamily()[0] in FONTS else 1.65
    return 1.8 + digit * longest + (_LINE_MM * (1 + label.count("\n")) if label else 0.0)


def _legend(figure: Any, width: float) -> int:
    """Write the legend of all axes, unless it is of a single mark; returns the number of its lines."""
    handles: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if len(handles) < 2:
        return 0
    longest = max(len(label) for label in handles)
    columns = max(1, min(len(handles), int(width // (1.15 * longest + 9.0))))
    figure.legend(
        handles.values(), handles, loc="upper center", bbox_to_anchor=(0.5, 1.0), ncols=columns, handlelength=1.8,
        columnspacing=1.2, borderpad=0.1, borderaxespad=0.1, labelspacing=0.3,
    )  # fmt: skip
    return math.ceil(len(handles) / columns)


def _text(text: str) -> str:
    for sign, shown in _TEXTS.items():
        text = text.replace(sign, shown)
    return text


@contextmanager
def _plain() -> Iterator[None]:
    yield


@contextmanager
def _without_latex() -> Iterator[None]:
    """PGF written where no LaTeX is installed to measure text and try how images are included."""
    import matplotlib
    from matplotlib.backend_bases import RendererBase
    from matplotlib.backends import backend_pgf

    if shutil.which(matplotlib.rcParams["pgf.texsystem"]):
        yield
        return
    module: Any = backend_pgf
    renderer = module.RendererPgf
    measure, inclusion = renderer.get_text_width_height_descent, module._get_image_inclusion_command
    renderer.get_text_width_height_descent = RendererBase.get_text_width_height_descent
    module._get_image_inclusion_command = lambda: r"\includegraphics"
    try:
        yield
    finally:
        renderer.get_text_width_height_descent = measure
        module._get_image_inclusion_command = inclusion
