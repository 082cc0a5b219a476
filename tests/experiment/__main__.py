"""`make experiment`: play the experiment, check the run, and write the report."""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import time
from pathlib import Path
from typing import get_args

from tests.kit.bag import write_bag

from . import crowd, figures, report, routes
from .bags import bag_tracks
from .checks import checks
from .experiment import ROOT, Experiment
from .fleet import Carrier
from .large import LargeExperiment
from .measures import STAGES, quantiles, savings, steps
from .outcome import Settings
from .rules import Near


def main() -> int:
    """Run the experiment and write its report; return 0 if all checks pass, else 1."""
    parser = argparse.ArgumentParser(prog="make experiment EXPERIMENT=…", description=__doc__)
    parser.add_argument("--gitops", choices=("flux", "argocd"), default="flux")
    parser.add_argument(
        "--connections",
        choices=get_args(Carrier),
        default="mqtt",
        help="what carries the data to the edge",
    )
    parser.add_argument("--seed", type=int, default=0, help="0: the paper's order of events")
    parser.add_argument(
        "--gap",
        type=float,
        default=10.0,
        help="about how many seconds of driving lie between two events",
    )
    parser.add_argument("--short", action="store_true", help="one vehicle comes and leaves")
    parser.add_argument("--vanish", choices=routes.VEHICLES, default="", help="who falls silent")
    parser.add_argument(
        "--large",
        type=int,
        nargs="?",
        const=200,
        default=0,
        metavar="VEHICLES",
        help="the larger experiment: 200 vehicles or as many as given, which only send poses",
    )
    parser.add_argument("--bag", default="", help="take the vehicles' poses from a recorded bag")
    given = parser.parse_args()
    tracks = bag_tracks(Path(given.bag), Near.read()) if given.bag else ()
    if given.large and (given.gitops, given.connections) != ("flux", "mqtt"):
        parser.error("--large runs with Flux and MQTT only")
    settings = Settings(**vars(given), tracks=tracks)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    folder = ROOT / "build" / "experiment"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    began = time.monotonic()

    def say(text: str) -> None:
        print(f"{time.monotonic() - began:6.1f} s  {text}", flush=True)

    if settings.large:
        large = LargeExperiment(settings, folder, say)
        outcome = large.run()
        found = crowd.checks(outcome, large.passing)
    else:
        outcome = Experiment(settings, folder, say).run()
        found = checks(outcome)
    say("the clusters are down")
    bag = folder / "poses"
    write_bag(bag, ((pose.at, pose.vehicle, pose.x, pose.y) for pose in outcome.poses))
    say(f"the poses that the vehicles sent are recorded in {bag.relative_to(ROOT)}")
    file = folder / "report.html"
    file.write_text(report.page(outcome, found))
    plots = report.plots(outcome)
    for name, plot in plots.items():
        (folder / f"{name}.svg").write_text(plot)
    if os.environ.get("FIGURES"):
        figures.draw(plots, ROOT / "docs" / "figures")
    for check in found:
        print(f"{'ok   ' if check.holds else 'FAULT'} {check.name}")
        if not check.holds:
            print(f"      {check.fault}")
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
    print(f"report: {file.relative_to(Path.cwd()) if file.is_relative_to(Path.cwd()) else file}")
    return 0 if all(check.holds for check in found) else 1


if __name__ == "__main__":
    sys.exit(main())
