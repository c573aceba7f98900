"""Run one step of a batch: ``python -m reproduce.experiments.workflow.step PARENT train ...``.

Steps are told to end as soon as Snakemake, their parent, has ended by whatever means: a training writes its checkpoint
and goes on from it with the next batch, and none runs on beside that one.
"""

import runpy
import signal
import sys

from reproduce.storage.processes import end_with

if __name__ == "__main__":
    end_with(int(sys.argv.pop(1)), signal.SIGTERM)
    runpy.run_module("reproduce", run_name="__main__", alter_sys=True)
