"""Settings of the port on which the server is watched: the section ``[metrics]``."""

from typing import Annotated

from pydantic import BaseModel, Field

from triquad_server.settings.section import SECTION


class MetricsSettings(BaseModel):
    """Figures for Prometheus and health for supervisors, over HTTP."""

    model_config = SECTION

    port: Annotated[int, Field(ge=0, le=65535)] = 0
    """Where `/metrics` and `/healthz` are answered; 0: nowhere. The flag `--metrics-port` says the
    same."""

    address: Annotated[str, Field(min_length=1, max_length=255)] = "127.0.0.1"
    """Of the network interface that is listened on: `0.0.0.0` for all; whoever reaches it may
    read."""
