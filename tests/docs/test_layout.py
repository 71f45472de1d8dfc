"""The layout for Foxglove and Lichtblick against the fields of their panels, and against a recorded log."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from tests.docs.markdown import ROOT

LAYOUT = json.loads((ROOT / "configs/layouts/lwr.json").read_text())
TITLES = {"foxglovePanelTitle", "lichtblickPanelTitle"}
# Fields of the panels as Lichtblick's sources declare them (PlotConfig, StateTransitionConfig, 3D), those that are
# needed first.
FIELDS: dict[str, tuple[set[str], set[str]]] = {
    "Plot": (
        {
            "paths",
            "showLegend",
            "legendDisplay",
            "showPlotValuesInLegend",
            "showXAxisLabels",
            "showYAxisLabels",
        }
        | {"isSynced", "xAxisVal", "sidebarDimension"},
        {"minYValue", "maxYValue", "followingViewWidth"} | TITLES,
    ),
    "StateTransitions": ({"paths", "isSynced"}, {"xAxisRange", "showPoints"} | TITLES),
    "3D": (
        {"cameraState", "followMode", "followTf", "scene", "transforms", "topics", "layers", "publish"},
        TITLES,
    ),
}
PATH = ({"value", "timestampMethod"}, {"enabled", "label", "color", "showLine", "lineSize"})


def panels(part: Any) -> Iterator[str]:
    if isinstance(part, str):
        yield part
        return
    assert part["direction"] in ("row", "column")
    assert 0 < part.get("splitPercentage", 50) < 100
    for side in ("first", "second"):
        yield from panels(part[side])


def check(content: dict[str, Any], fields: tuple[set[str], set[str]], where: str) -> None:
    needed, optional = fields
    assert needed <= set(content), f"{where} lacks {needed - set(content)}"
    assert set(content) <= needed | optional, f"{where} has {set(content) - needed - optional}"


def test_every_panel_is_placed_once_and_configured() -> None:
    assert set(LAYOUT) == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}
    placed = list(panels(LAYOUT["layout"]))
    assert sorted(placed) == sorted(LAYOUT["configById"])


@pytest.mark.parametrize("panel", LAYOUT["configById"])
def test_a_panel_has_the_fields_of_its_kind(panel: str) -> None:
    content = LAYOUT["configById"][panel]
    check(content, FIELDS[panel.split("!")[0]], panel)
    for path in content.get("paths", []):
        check(path, PATH, f"{panel} {path['value']}")
        assert path["timestampMethod"] in ("receiveTime", "headerStamp")


def test_the_robot_is_drawn_from_its_description() -> None:
    layer = LAYOUT["configById"]["3D!arm"]["layers"]["urdf"]
    assert {"layerId", "instanceId", "sourceType", "topic", "framePrefix", "displayMode"} <= set(layer)
    assert (layer["layerId"], layer["sourceType"], layer["topic"]) == (
        "foxglove.Urdf",
        "topic",
        "/robot_description",
    )


def test_every_path_leads_to_a_field_of_a_log(laboratory: Path) -> None:
    messages: dict[str, Any] = {}
    with (laboratory / "loaded.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            messages.setdefault(channel.topic, message)
    assert "/robot_description" in messages
    for content in LAYOUT["configById"].values():
        for path in content.get("paths", []):
            found = re.fullmatch(r"(/[\w/]+)\.(\w+)(?:\[(\d+)\])?", path["value"])
            assert found is not None, path["value"]
            value = getattr(messages[found[1]], found[2])
            if found[3] is not None:
                value = value[int(found[3])]
            assert isinstance(value, (int, float, str)), path["value"]
            assert path["timestampMethod"] == "receiveTime" or hasattr(messages[found[1]], "header")


def test_every_curve_of_the_plotjuggler_layout_is_a_joint_of_a_log(laboratory: Path) -> None:
    names: dict[str, tuple[str, ...]] = {}
    with (laboratory / "loaded.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages(
            topics=["/joint_states", "/motor_states", "/joint_command"]
        ):
            names.setdefault(channel.topic, tuple(message.name))
    layout = ElementTree.parse(ROOT / "configs/layouts/plotjuggler.xml").getroot()
    curves = [str(curve.get("name")) for curve in layout.iter("curve")]
    assert len(curves) == 4 * 7
    for curve in curves:
        topic, joint, field = curve.rsplit("/", 2)
        assert joint in names[topic]
        assert field in ("position", "effort")
    for splitter in layout.iter("DockSplitter"):
        assert len(splitter.findall("DockArea")) == int(splitter.get("count", "0"))
