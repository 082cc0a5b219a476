"""`make experiment`: play the experiment, check the run, and write the report."""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from . import large, report, routes, unlisted
from .checks import checks
from .experiment import ROOT, Experiment
from .fleet import Carrier
from .outcome import STAGES, Outcome, Settings, quantiles, savings, steps
from .rig import chromium, write_bag
from .rules import Near, bag_tracks
from .unlisted import UnlistedExperiment


def _settings() -> Settings:
    parser = argparse.ArgumentParser(prog="make experiment EXPERIMENT=…", description=__doc__)
    add = parser.add_argument
    add("--gitops", choices=("flux", "argocd"), default="flux")
    add("--connections", choices=get_args(Carrier), default="mqtt", help="carry data to the edge")
    add("--seed", type=int, default=0, help="0: the paper's order of events")
    add("--gap", type=float, default=10.0, help="about how many seconds lie between two events")
    add("--short", action="store_true", help="one vehicle comes and leaves")
    add("--vanish", choices=routes.VEHICLES, default="", help="who falls silent")
    many = "the larger experiment: 200 vehicles or as many as given, which only send poses"
    add("--large", type=int, nargs="?", const=200, default=0, metavar="VEHICLES", help=many)
    few = "as many vehicles that nobody listed, two applications, CAMs, and data that come back"
    add("--unlisted", type=int, nargs="?", const=20, default=0, metavar="VEHICLES", help=few)
    add("--bag", default="", help="take the vehicles' poses from a recorded bag")
    given = parser.parse_args()
    if given.large and (given.gitops, given.connections) != ("flux", "mqtt"):
        parser.error("--large runs with Flux and MQTT only")
    tracks = bag_tracks(Path(given.bag), Near.read()) if given.bag else ()
    return Settings(**vars(given), tracks=tracks)


def main() -> int:
    settings = _settings()
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    folder = ROOT / "build" / "experiment"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    began = time.monotonic()

    def say(text: str) -> None:
        print(f"{time.monotonic() - began:6.1f} s  {text}", flush=True)

    if settings.large:
        crowd = large.LargeExperiment(settings, folder, say)
        outcome = crowd.run()
        found = large.checks(outcome, crowd.passing)
    elif settings.unlisted:
        outcome = UnlistedExperiment(settings, folder, say).run()
        found = unlisted.checks(outcome)
    else:
        outcome = Experiment(settings, folder, say).run()
        found = checks(outcome)
    say("the clusters are down")
    bag = folder / "poses"
    write_bag(bag, ((pose.at, pose.vehicle, pose.x, pose.y) for pose in outcome.poses))
    say(f"the poses that the vehicles sent are recorded in {bag.relative_to(ROOT)}")
    file = folder / "report.html"
    file.write_text(report.page(outcome, found))
    if os.environ.get("FIGURES"):
        _draw(report.plots(outcome), ROOT / "docs" / "figures")
    for check in found:
        print(f"{'ok   ' if check.holds else 'FAULT'} {check.name}")
        if not check.holds:
            print(f"      {check.fault}")
    _print_measures(outcome)
    print(f"report: {file.relative_to(Path.cwd()) if file.is_relative_to(Path.cwd()) else file}")
    return 0 if all(check.holds for check in found) else 1


def _print_measures(outcome: Outcome) -> None:
    for joins, word in ((True, "joins"), (False, "leaves")):
        delays = [step.delays() for step in steps(outcome) if step.event.joins is joins]
        for stage in STAGES:
            if values := tuple(each[stage] for each in delays if stage in each):
                low, median, high = quantiles(values)
                span = f"{low:.2f} to {high:.2f} s, median {median:.2f} s"
                print(f"      a vehicle {word}, to {stage}: {span}")
    for saving in savings(outcome):
        amounts = f"{saving.on_demand:.2f} in place of {saving.always:.2f} {saving.unit}".rstrip()
        print(f"      {saving.name}: {amounts}, {saving.saved:.0%} saved")


def _draw(plots: Mapping[str, str], folder: Path) -> None:
    """Draw the plots as images for the docs, with a headless browser."""
    size: Any = {"width": 900, "height": 600}
    with chromium() as browser:
        page = browser.new_page(viewport=size, device_scale_factor=1.5)
        for name, plot in plots.items():
            page.set_content(f'<body style="margin:0">{plot}</body>')
            page.locator("svg").screenshot(path=folder / f"experiment-{name}.png")


if __name__ == "__main__":
    sys.exit(main())
