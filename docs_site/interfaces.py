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
        shown = f"`{parameter.default}`" if parameter.default != "" else ""
        limits = f" ({parameter.limits})" if parameter.limits else ""
        rows.append(f"| `{name}` | {shown} | {parameter.description}{limits} |")
    return "\n".join(rows)
