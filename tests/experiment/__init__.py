"""The paper's experiment without scripted demands: `make experiment` (docs/experiment.md)."""
