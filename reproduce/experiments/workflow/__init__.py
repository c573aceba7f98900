"""The whole reproduction as a workflow of the project's own commands, on one machine or a cluster."""
