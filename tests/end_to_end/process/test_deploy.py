"""What is in docs/deploy: a unit of systemd, an image, services of compose.

There is no container engine here: the steps of the image are followed in folders of this machine,
over the libraries that are installed.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import venv
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import triquad_client
from ruamel.yaml import YAML
from support import servers
from support.dockerfile import Stage, stages
from triquad_format.mapfile.reader import read_map

ROOT = Path(__file__).parents[3]
DEPLOY = ROOT / "docs" / "deploy"
INSTALLED, STORE = "/opt/triquad", "/var/lib/triquad"  # in the image
COMPILING = "compiling, step"


class Image(NamedTuple):
    """The image as folders."""

    final: Stage
    folder: Path

    def here(self, text: str) -> str:
        """A text of the Dockerfile with the folders of this machine."""
        installed, store = str(self.folder / "installed"), str(self.folder / "store")
        return text.replace(INSTALLED, installed).replace(STORE, store)

    def environment(self, stage: Stage, **others: str) -> dict[str, str]:
        path = {"PATH": os.environ["PATH"]}
        own = {name: self.here(value) for name, value in stage.environment.items()}
        own["PATH"] = own["PATH"].replace("$PATH", os.environ["PATH"])
        return path | own | others


def installed_packages() -> list[str]:
    """Where the libraries lie that are installed, without those of editable installations."""
    return [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Image:
    pytest.importorskip("hatchling", reason="the wheel cannot be built without hatchling")
    pytest.importorskip("pip", reason="the wheel cannot be installed without pip")
    build, final = stages(DEPLOY / "Dockerfile")
    image = Image(final, tmp_path_factory.mktemp("image"))
    sources, installed = image.folder / "src", image.folder / "installed"
    sources.mkdir()
    for step in build.all("COPY"):
        *names, target = step.split()
        for name in names:
            copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
            copy(ROOT / name, sources / target / ("" if target == "./" else "."))
    make, ours, warm_up = build.all("RUN")
    assert make == f"python -m venv {INSTALLED}"
    venv.create(installed, with_pip=False)
    (packages,) = installed.glob("lib/python*/site-packages")
    (packages / "libraries.pth").write_text("\n".join(installed_packages()))
    assert ours.endswith('".[$EXTRA]"')
    assert build.arguments["EXTRA"] == "server,ros"
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    alone = ["--no-deps", "--no-index", "--no-build-isolation"]
    subprocess.run([*pip, "wheel", *alone, "-w", image.folder, sources], check=True)
    (wheel,) = image.folder.glob("*.whl")
    pip[3:3] = ["--python", str(installed / "bin" / "python")]
    subprocess.run([*pip, "install", "--no-deps", "--no-index", wheel], check=True)
    subprocess.run(
        ["sh", "-c", warm_up], check=True, cwd=image.folder, env=image.environment(build)
    )
    return image


@pytest.mark.long
def test_a_container_starts_with_compiled_code_tells_its_health_and_keeps_its_map(image) -> None:
    assert image.final.one("STOPSIGNAL") == "SIGTERM"
    assert image.final.one("VOLUME") == STORE
    endpoint, port = servers.free_endpoint(), servers.free_endpoint().rpartition(":")[2]
    environment = image.environment(image.final, TRIQUAD_METRICS__PORT=port, HOME=str(image.folder))
    check = image.final.command("HEALTHCHECK")

    def is_healthy() -> bool:
        done = subprocess.run(check, env=environment, capture_output=True, timeout=servers.WAIT_S)
        return done.returncode == 0

    command = [image.here(word) for word in image.final.command("ENTRYPOINT")]
    command[command.index("tcp/0.0.0.0:7447")] = endpoint
    assert not is_healthy()
    with subprocess.Popen(
        [*command, "--no-multicast-scouting"],
        env=environment,
        cwd=image.folder,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        server = servers.ServerProcess(process, endpoint)
        try:
            server.wait_for("ready: ")
            assert is_healthy()
            with triquad_client.connect(endpoint) as client:
                servers.learn(client)
            process.send_signal(signal.SIGTERM)
            assert server.wait() == 0
        finally:
            process.kill()
    assert not is_healthy()
    assert COMPILING not in server.log
    messages = [json.loads(line)["message"] for line in server.lines]
    assert messages[-1] == "stopped"
    (checkpoint,) = (image.folder / "store" / "default").glob("*.checkpoint")
    assert read_map(checkpoint).regions


def test_what_the_image_copies_is_in_its_context() -> None:
    build, final = stages(DEPLOY / "Dockerfile")
    kept = {
        line[1:] for line in (ROOT / ".dockerignore").read_text().split() if line.startswith("!")
    }
    copied = {name for step in build.all("COPY") for name in step.split()[:-1]}
    assert copied == kept
    assert all((ROOT / name).exists() for name in copied)
    assert final.one("COPY").split()[:2] == ["--from=build", "--chown=triquad:triquad"]
    assert final.one("USER") == "triquad"


def test_kernels_are_looked_for_where_and_as_they_were_compiled() -> None:
    build, final = stages(DEPLOY / "Dockerfile")
    for name in ("NUMBA_CACHE_DIR", "NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES"):
        assert build.environment[name] == final.environment[name]


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


def test_compose_names_files_and_volumes_that_there_are(compose) -> None:
    for service in compose["services"].values():
        for source in mounts(service).values():
            assert (DEPLOY / source).is_file() if "/" in source else source in compose["volumes"]
    build = compose["services"]["server"]["build"]
    context = (DEPLOY / build["context"]).resolve()
    assert context == ROOT
    assert (context / build["dockerfile"]).samefile(DEPLOY / "Dockerfile")


def test_compose_runs_the_server_as_the_image_means_it(compose) -> None:
    _, final = stages(DEPLOY / "Dockerfile")
    server = compose["services"]["server"]
    assert mounts(server) == {final.one("VOLUME"): "maps"}
    assert [port.split(":")[-1] for port in server["ports"]] == ["7447"]
    assert "tcp/0.0.0.0:7447" in final.command("ENTRYPOINT")
    assert final.one("EXPOSE").split() == ["7447", final.environment["TRIQUAD_METRICS__PORT"]]
    assert server["stop_grace_period"] == "5m"


def test_what_watches_is_wired_up_and_only_on_request(compose) -> None:
    _, final = stages(DEPLOY / "Dockerfile")
    services = compose["services"]
    watchers = {name for name, service in services.items() if "profiles" in service}
    assert watchers == {"prometheus", "grafana"}
    assert "profiles" not in services["server"]
    (scraped,) = yaml(DEPLOY / "prometheus.yml")["scrape_configs"]
    port = final.environment["TRIQUAD_METRICS__PORT"]
    assert scraped["static_configs"] == [{"targets": [f"server:{port}"]}]
    (source,) = yaml(DEPLOY / "grafana-datasource.yaml")["datasources"]
    assert source["url"] == "http://prometheus:9090"
    (provider,) = yaml(DEPLOY / "grafana-dashboards.yaml")["providers"]
    dashboards = [
        DEPLOY / file
        for target, file in mounts(services["grafana"]).items()
        if str(Path(target).parent) == provider["options"]["path"]
    ]
    (dashboard,) = dashboards
    assert json.loads(dashboard.read_text())["panels"]
    assert all(
        published.startswith("127.0.0.1:")
        for name in watchers
        for published in services[name]["ports"]
    )


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
