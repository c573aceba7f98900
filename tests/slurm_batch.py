"""``make test-slurm``: the smoke batch under a real Slurm on this machine, one job cancelled, against a local run.

Installs Debian's slurm-wlm and munge where they are missing, starts munged, slurmctld and slurmd with a configuration
of one node and no accounting, and stops them at the end. Needs root on Debian 12; elsewhere it says why it skips.
"""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

CONFIGURATION = Path("/etc/slurm/slurm.conf")  # job steps look for it here, whatever SLURM_CONF says
SPOOL = Path("/var/spool/lunar_rescue_slurm")
METHODS = "random,scripted,ppo_lstm,hrl_dcs"
AT_LEAST = 4  # jobs
PATIENCE = 900  # s


def main() -> int:
    """Run; 0 when it passed or had to be skipped."""
    reason = why_not()
    if reason:
        print(f"test-slurm: skipped: {reason}")
        return 0
    install()
    with tempfile.TemporaryDirectory(prefix="lunar_rescue_slurm_") as name, slurm():
        return compare(Path(name))


def why_not() -> str:
    """Why this cannot run here, or nothing."""
    release = Path("/etc/os-release")
    words = release.read_text(encoding="utf-8") if release.is_file() else ""
    if "ID=debian" not in words or 'VERSION_ID="12"' not in words:
        return "needs Debian 12"
    if os.geteuid() != 0:
        return "needs root, to start munged, slurmctld and slurmd"
    if CONFIGURATION.is_file() and str(SPOOL) not in CONFIGURATION.read_text(encoding="utf-8"):
        return f"{CONFIGURATION} belongs to another Slurm on this machine"
    return ""


def install() -> None:
    """Install what is missing."""
    if all(shutil.which(name) for name in ("slurmctld", "slurmd", "munged", "sbatch")):
        return
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    for command in (["apt-get", "update", "-q"], ["apt-get", "install", "-qy", "slurm-wlm", "munge"]):
        subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL)


@contextmanager
def slurm() -> Iterator[None]:
    """A Slurm of one node, while the block runs."""
    host, cores = socket.gethostname(), len(os.sched_getaffinity(0))
    shutil.rmtree(SPOOL, ignore_errors=True)
    for name in ("state", "node"):
        (SPOOL / name).mkdir(parents=True)
    CONFIGURATION.parent.mkdir(exist_ok=True)
    settings = {
        "ClusterName": "lunar",
        "SlurmctldHost": host,
        "SlurmUser": "root",
        "AuthType": "auth/munge",
        "StateSaveLocation": SPOOL / "state",
        "SlurmdSpoolDir": SPOOL / "node",
        "SlurmctldPidFile": SPOOL / "slurmctld.pid",
        "SlurmdPidFile": SPOOL / "slurmd.pid",
        "SlurmctldLogFile": SPOOL / "slurmctld.log",
        "SlurmdLogFile": SPOOL / "slurmd.log",
        "ProctrackType": "proctrack/linuxproc",
        "TaskPlugin": "task/none",
        "SelectType": "select/cons_tres",
        "SelectTypeParameters": "CR_Core",
        "AccountingStorageType": "accounting_storage/none",
        "JobAcctGatherType": "jobacct_gather/none",
        "ReturnToService": 2,
        "MpiDefault": "none",
        "NodeName": f"{host} CPUs={cores} RealMemory=16000 State=UNKNOWN",
        "PartitionName": f"main Nodes={host} Default=YES MaxTime=INFINITE State=UP OverSubscribe=NO",
    }
    CONFIGURATION.write_text("".join(f"{key}={value}\n" for key, value in settings.items()), encoding="utf-8")
    daemons = start_daemons()
    try:
        wait_until("the node is idle", lambda: "idle" in output("sinfo", "-h", "-o", "%T"), 60)
        yield
    finally:
        subprocess.run(["scancel", "--user", "root"], check=False)
        for daemon in reversed(daemons):
            daemon.terminate()
            daemon.wait(timeout=30)
        CONFIGURATION.unlink(missing_ok=True)
        shutil.rmtree(SPOOL, ignore_errors=True)


def start_daemons() -> list[subprocess.Popen[bytes]]:
    """munged, slurmctld and slurmd in the foreground, so that they end with this script."""
    run = Path("/run/munge")
    run.mkdir(exist_ok=True)
    munge = pwd.getpwnam("munge")
    os.chown(run, munge.pw_uid, munge.pw_gid)

    def start(*command: str, user: str | None = None) -> subprocess.Popen[bytes]:
        return subprocess.Popen(command, user=user, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    daemons = [start("munged", "--foreground", user="munge")]
    wait_until("munge answers", lambda: subprocess.run(["munge", "-n"], capture_output=True).returncode == 0, 30)
    daemons += [start("slurmctld", "-D"), start("slurmd", "-D")]
    return daemons


def output(*command: str) -> str:
    """What a command prints."""
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout


def wait_until(what: str, true: object, seconds: float) -> None:
    """Wait until a function gives true."""
    end = time.monotonic() + seconds
    while not true():  # type: ignore[operator]
        if time.monotonic() > end:
            raise SystemExit(f"test-slurm: FAILED: waited {seconds:.0f} s until {what}")
        time.sleep(0.5)


def batch(out: Path, *options: str) -> list[str]:
    """The command."""
    command = [sys.executable, "-m", "reproduce", "batch", "--preset", "smoke", "--methods", METHODS, "--slots", "2"]
    return [*command, "--threads", "1", "--until", "tables", "--out", str(out), *options]


def compare(folder: Path) -> int:
    """Run under Slurm, cancel one job on the way, run locally, compare tables."""
    there, here = folder / "slurm", folder / "local"
    process = subprocess.Popen(batch(there, "--profile", "slurm"))
    seen: set[str] = set()
    cancelled = ""
    end = time.monotonic() + PATIENCE
    while process.poll() is None:
        running = [line.split() for line in output("squeue", "-h", "-o", "%i %T").splitlines()]
        seen |= {number for number, _ in running}
        if not cancelled:
            cancelled = next((number for number, state in running if state == "RUNNING"), "")
            if cancelled:
                time.sleep(2.0)
                subprocess.run(["scancel", cancelled], check=True)
                print(f"test-slurm: cancelled job {cancelled}")
        if time.monotonic() > end:
            process.send_signal(signal.SIGINT)
            return failed(f"the batch took more than {PATIENCE} s")
        time.sleep(0.5)
    log = (there / "logs" / "snakemake.log").read_text(encoding="utf-8")
    if process.returncode != 0:
        return failed(f"the batch under Slurm ended with code {process.returncode}")
    if len(seen) < AT_LEAST:
        return failed(f"expected at least {AT_LEAST} Slurm jobs, saw {len(seen)}")
    if "Trying to restart job" not in log:
        return failed("the cancelled job was not started again")
    subprocess.run(batch(here), check=True)
    names = sorted(path.name for path in (here / "tables").glob("*.csv"))
    differ = [n for n in names if (here / "tables" / n).read_bytes() != (there / "tables" / n).read_bytes()]
    if differ or not names:
        return failed(f"tables differ from the local run's: {', '.join(differ) or 'there are none'}")
    print(f"test-slurm: passed: {len(seen)} Slurm jobs, one cancelled and started again, {len(names)} tables equal")
    return 0


def failed(words: str) -> int:
    """Say so."""
    print(f"test-slurm: FAILED: {words}")
    return 1


if __name__ == "__main__":
    sys.exit(main())
