"""Makes the page of the ROS 2 interfaces and parameters.

Their sources are the interface files and the node's own table of parameters.
"""

from __future__ import annotations

from pathlib import Path

from demandops_ros import node_parameters

INTERFACES = Path(__file__).parents[1] / "ros_bridge" / "interfaces"


def page() -> str:
    """Return the page as Markdown."""
    parts = [
        "# ROS 2 interfaces and parameters",
        "Generated from the interface files and from the node.",
        "## Parameters of the node",
        _parameters(),
    ]
    for package in sorted(path.parent for path in INTERFACES.glob("*/package.xml")):
        parts.append(f"## {package.name}")
        for kind in ("action", "srv", "msg"):
            for file in sorted(package.glob(f"{kind}/**/*.{kind}")):
                name = f"{package.name}/{kind}/{file.stem}"
                parts += [f"### {name}", f"```text\n{file.read_text().strip()}\n```"]
    return "\n\n".join(parts) + "\n"


def _parameters() -> str:
    rows = ["| parameter | default | meaning |", "| --- | --- | --- |"]
    for name, parameter in node_parameters.PARAMETERS.items():
        told, default = parameter.descriptor(), parameter.default
        ranges = [
            f"{one.from_value:g} to {one.to_value:g}"
            for one in (*told.floating_point_range, *told.integer_range)
        ]
        limits = "; ".join([*filter(None, [told.additional_constraints]), *ranges])
        shown = f"`{default}`" if default != "" else ""
        rows.append(
            f"| `{name}` | {shown} | {told.description}{f' ({limits})' if limits else ''} |"
        )
    return "\n".join(rows)
