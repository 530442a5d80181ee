"""The commands of docs/cluster.md: their options exist, and the batch script gives each task its shard."""

import os
import re
import subprocess

import pytest
from places import DOCS

from magtwin import cli
from magtwin.cli.app import app
from magtwin.parallel import parse_shard

cli.load()

PAGE = (DOCS / "cluster.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)


def parsed(words):
    """What a command of magtwin gets, without running it."""
    return app.parse_args(words, exit_on_error=False, print_error=False)[1].arguments


def test_the_batch_script_shares_the_work_between_its_tasks(tmp_path):
    (script,) = blocks("bash")
    assert re.search(r"^#SBATCH --array=0-9$", script, re.MULTILINE)
    (tmp_path / "magtwin").write_text('#!/bin/bash\nprintf "%s\\n" "$@"\n')
    (tmp_path / "magtwin").chmod(0o755)
    (tmp_path / "bench.sh").write_text(script)
    shards = []
    for task in range(10):
        slurm = {"SLURM_ARRAY_TASK_ID": str(task), "SLURM_ARRAY_TASK_COUNT": "10", "SLURM_CPUS_PER_TASK": "8"}
        path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
        done = subprocess.run(
            ["bash", "-eu", "bench.sh"],
            cwd=tmp_path,
            env={**os.environ, **slurm, "PATH": path, "SCRATCH": str(tmp_path)},
            capture_output=True,
            text=True,
            check=True,
        )
        given = parsed(done.stdout.splitlines())
        assert (given["suite"], given["out"], given["jobs"]) == ("standard", tmp_path / "results", 8)
        shards.append(parse_shard(given["shard"]))
    assert shards == [(task, 10) for task in range(10)]


def test_the_deployments_start_a_scheduler_and_workers_that_reach_it():
    pytest.importorskip("distributed")
    import yaml
    from distributed.cli import dask_scheduler, dask_worker

    (text,) = blocks("yaml")
    scheduler, service, worker = yaml.safe_load_all(text)
    for made in (scheduler, worker):
        labels = made["spec"]["template"]["metadata"]["labels"]
        assert made["spec"]["selector"]["matchLabels"] == labels
    assert service["spec"]["selector"] == scheduler["spec"]["template"]["metadata"]["labels"]
    commands = [made["spec"]["template"]["spec"]["containers"][0]["command"] for made in (scheduler, worker)]
    assert commands[0][:2] == ["dask", "scheduler"]
    assert commands[1][:2] == ["dask", "worker"]
    started = dask_scheduler.main.make_context("scheduler", commands[0][2:])
    joined = dask_worker.main.make_context("worker", commands[1][2:])
    assert joined.params["scheduler"] == f"tcp://{service['metadata']['name']}:8786"
    assert service["spec"]["ports"] == [{"port": started.params["port"] or 8786}]
    assert (
        str(joined.params["nthreads"])
        == worker["spec"]["template"]["spec"]["containers"][0]["resources"]["requests"]["cpu"]
    )
