"""What is in docs/deploy: a unit of systemd, an image, services of compose.

There is no container engine here: what the image starts is started on this machine.
"""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import triquad_client
from ruamel.yaml import YAML
from support import servers
from triquad_format.mapfile.reader import read_map

ROOT = Path(__file__).parents[3]
DEPLOY = ROOT / "docs" / "deploy"
_, BUILD, FINAL = re.split(
    "^FROM .*$", (DEPLOY / "Dockerfile").read_text().replace("\\\n", " "), flags=re.MULTILINE
)
"""The instructions of both stages of the image."""


def steps(stage: str, instruction: str) -> list[str]:
    return re.findall(rf"^{instruction} +(.*)$", stage, re.MULTILINE)


def words(stage: str, instruction: str) -> list[str]:
    """The words of an instruction in the form of a list."""
    (text,) = steps(stage, instruction)
    found: list[str] = json.loads(text[text.index("[") :])
    return found


def environment(stage: str) -> dict[str, str]:
    pairs = (word.split("=", 1) for word in shlex.split(" ".join(steps(stage, "ENV"))))
    return {name: value for name, value in pairs}


def test_what_the_image_starts_tells_its_health_and_keeps_its_map(tmp_path: Path) -> None:
    endpoint, port = servers.free_endpoint(), servers.free_endpoint().rpartition(":")[2]
    variables = {**environment(FINAL), "TRIQUAD_METRICS__PORT": port}
    variables = {name: value for name, value in variables.items() if name.startswith("TRIQUAD")}

    def is_healthy() -> bool:
        _, *check = words(FINAL, "HEALTHCHECK")
        done = subprocess.run([sys.executable, *check], env={**os.environ, **variables})
        return done.returncode == 0

    program, *arguments = words(FINAL, "ENTRYPOINT")
    assert Path(program).name == "triquad-server"
    (store,) = steps(FINAL, "VOLUME")
    assert arguments == ["--listen", "tcp/0.0.0.0:7447", "--store", store]
    assert not is_healthy()
    servers.compiled()
    with servers.server_process(["--store", tmp_path], endpoint, environment=variables) as server:
        assert is_healthy()
        with triquad_client.connect(endpoint) as client:
            servers.learn(client)
        (name,) = steps(FINAL, "STOPSIGNAL")
        server.process.send_signal(signal.Signals[name])
        assert server.wait() == 0
    assert not is_healthy()
    assert json.loads(server.lines[-1])["message"] == "stopped"
    (checkpoint,) = (tmp_path / "default").glob("*.checkpoint")
    assert read_map(checkpoint).regions


def test_what_the_image_copies_is_in_its_context_and_is_installed_with_its_kernels() -> None:
    kept = {
        line[1:] for line in (ROOT / ".dockerignore").read_text().split() if line.startswith("!")
    }
    copied = {name for step in steps(BUILD, "COPY") for name in step.split()[:-1]}
    assert copied == kept
    assert all((ROOT / name).exists() for name in copied)
    assert steps(FINAL, "COPY")[0].split()[:2] == ["--from=build", "--chown=triquad:triquad"]
    assert steps(FINAL, "USER") == ["triquad"]
    assert steps(BUILD, "RUN")[-1] == "python -m triquad_server.warm_up"
    for name in ("NUMBA_CACHE_DIR", "NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES"):
        assert environment(BUILD)[name] == environment(FINAL)[name], "where kernels are looked for"


@pytest.fixture
def compose() -> dict[str, Any]:
    loaded: dict[str, Any] = yaml(DEPLOY / "compose.yaml")
    return loaded


def yaml(path: Path) -> Any:
    return YAML(typ="safe").load(path)


def mounts(service: dict[str, Any]) -> dict[str, str]:
    """Sources of a service's volumes, by where they are mounted."""
    parts = (volume.split(":") for volume in service["volumes"])
    return {target: source for source, target, *_ in parts}


def test_compose_runs_the_server_as_the_image_means_it(compose) -> None:
    for service in compose["services"].values():
        for source in mounts(service).values():
            assert (DEPLOY / source).is_file() if "/" in source else source in compose["volumes"]
    server = compose["services"]["server"]
    context = (DEPLOY / server["build"]["context"]).resolve()
    assert context == ROOT
    assert (context / server["build"]["dockerfile"]).samefile(DEPLOY / "Dockerfile")
    assert mounts(server) == {steps(FINAL, "VOLUME")[0]: "maps"}
    assert [port.split(":")[-1] for port in server["ports"]] == ["7447"]
    port = environment(FINAL)["TRIQUAD_METRICS__PORT"]
    assert steps(FINAL, "EXPOSE")[0].split() == ["7447", port]
    assert server["stop_grace_period"] == "5m"


def test_what_watches_is_wired_up_and_only_on_request(compose) -> None:
    services = compose["services"]
    watchers = {name for name, service in services.items() if "profiles" in service}
    assert watchers == {"prometheus", "grafana"}
    (scraped,) = yaml(DEPLOY / "prometheus.yml")["scrape_configs"]
    port = environment(FINAL)["TRIQUAD_METRICS__PORT"]
    assert scraped["static_configs"] == [{"targets": [f"server:{port}"]}]
    (source,) = yaml(DEPLOY / "grafana-datasource.yaml")["datasources"]
    assert source["url"] == "http://prometheus:9090"
    (provider,) = yaml(DEPLOY / "grafana-dashboards.yaml")["providers"]
    (dashboard,) = (
        DEPLOY / file
        for target, file in mounts(services["grafana"]).items()
        if str(Path(target).parent) == provider["options"]["path"]
    )
    assert json.loads(dashboard.read_text())["panels"]
    published = [port for name in watchers for port in services[name]["ports"]]
    assert all(port.startswith("127.0.0.1:") for port in published)


def unit_lines() -> list[str]:
    return (DEPLOY / "triquad-server.service").read_text().splitlines()


def test_systemd_takes_the_unit(tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed")
    unit = tmp_path / "triquad-server.service"
    # The program is somewhere else here.
    text = "\n".join(unit_lines()).replace("/opt/triquad/bin/triquad-server", sys.executable)
    unit.write_text(text + "\n")
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", unit], capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")
    unit.write_text(text.replace("WatchdogSec=2min", "WatchdogSec=soon") + "\n")
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", unit], capture_output=True, text=True
    )
    assert "Failed to parse sec value" in done.stderr


def test_the_server_takes_the_arguments_of_the_unit() -> None:
    (line,) = (line for line in unit_lines() if line.startswith("ExecStart="))
    _, *arguments = line.partition("=")[2].split()
    arguments.remove("$TRIQUAD_OPTIONS")
    done = subprocess.run(
        [sys.executable, "-m", "triquad_server.cli", *arguments, "--print-settings"],
        capture_output=True,
        text=True,
        timeout=servers.WAIT_S,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "port = 9464" in done.stdout
