"""The decision on one demand: the stages from goal to rendered files as one pure function."""

from demandops.decision.admitted_request import Checkpoint, admit, form_faults
from demandops.decision.claim_edit import changeset_of_edit, faults_of_edit
from demandops.decision.decision import Decision, Outcome, decide, scale_down
from demandops.decision.state import State, rendered_files, try_configuration

__all__ = [
    "Checkpoint",
    "Decision",
    "Outcome",
    "State",
    "admit",
    "changeset_of_edit",
    "decide",
    "faults_of_edit",
    "form_faults",
    "rendered_files",
    "scale_down",
    "try_configuration",
]
