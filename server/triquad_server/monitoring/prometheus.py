"""The metrics as Prometheus reads them: one table, and what turns it into text."""

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from prometheus_client import core, generate_latest
from prometheus_client.registry import Collector
from triquad_format.wire.metrics_messages import OperationMetrics, ServerMetrics, TimeHistogram
from triquad_format.wire.status_messages import ServerStatus

# Type, name, place in Figures, and meaning; each has the label `map` before its own. A test
# compares docs/metrics.md with it. In a place, {label} stands for the keys of a dictionary, and
# {label:a+b} for fields of a record: they become values of that label. Names from the network stand
# in the label `source` alone.
_TABLE = """
gauge     triquad_server_info                  info.{server}.{version}.{device}                     1; the labels name the map, this process, its release and what it computes on
gauge     triquad_healthy                      healthy                                              1 while the server does all that it should, as /healthz says; else 0
gauge     triquad_uptime_seconds               metrics.uptime_s                                     Time since the server began to serve
gauge     triquad_sessions                     sessions.{kind}                                      Zenoh sessions that are connected, by kind: client, peer or router
counter   triquad_scans_received_bytes_total   metrics.scan_bytes_received                          Bytes of scans that arrived over Zenoh
counter   triquad_scans_dropped_total          status.scans_dropped.{reason}                        Scans that were refused, by reason
counter   triquad_source_scans_total           metrics.sources.{source}.{outcome:taken+refused+lost} Scans of each source by outcome, of the 1024 publishers heard of last
gauge     triquad_source_age_seconds           metrics.sources.{source}.age_s                       Time since a scan of each source arrived
counter   triquad_points_dropped_total         status.points_dropped.{reason}                       Points and rays of taken scans that are not used, by reason
histogram triquad_request_duration_seconds     operations.{operation}.answers                       Time of answered requests, from arrival until the reply was sent
histogram triquad_request_wait_seconds         operations.{operation}.waits                         Time of requests from arrival until a worker took them
counter   triquad_requests_refused_total       metrics.operations.{operation}.refused.{code}        Requests that were refused, by error code
gauge     triquad_requests_pending             operations.{operation}.pending                       Requests without a reply yet
counter   triquad_request_received_bytes_total operations.{operation}.received_bytes                Bytes of requests
counter   triquad_request_sent_bytes_total     operations.{operation}.sent_bytes                    Bytes of answers
gauge     triquad_queue_waiting                metrics.queues.{queue}.waiting                       What waits in each queue
gauge     triquad_queue_limit                  metrics.queues.{queue}.limit                         What may wait in each queue, of scans for each source: beyond, the oldest scan is lost, and requests are refused
gauge     triquad_epoch                        metrics.epoch                                        Number of the newest epoch
gauge     triquad_epoch_age_seconds            metrics.epoch_age_s                                  Time since the newest epoch was published; grows while nothing changes
gauge     triquad_epochs_kept                  metrics.epochs_kept                                  Epochs that can be asked for by number
gauge     triquad_epochs_pinned                metrics.epochs_pinned                                Those of them that stay because they were asked for by number
gauge     triquad_regions                      status.regions                                       Regions of the map
gauge     triquad_regions_cold                 status.regions_cold                                  Of the regions, those that are read from the store where they are needed
gauge     triquad_vertices                     status.vertices                                      Quadtree vertices
gauge     triquad_parameters                   status.parameters                                    Learnable numbers
gauge     triquad_rays_kept                    status.rays_kept                                     Rays in the replay pools
gauge     triquad_replay_share                 status.replay_share                                  Of the rays that each place is to keep, the share that memory has room for
counter   triquad_rays_discarded_total         status.rays_discarded                                Rays that gave way to others of the same place
counter   triquad_samples_trained_total        metrics.samples_trained                              Training samples
gauge     triquad_samples_left                 status.samples_left                                  Training samples until nothing is left to learn
counter   triquad_samples_discarded_total      status.samples_discarded                             Training samples left out, beyond what the mapped area may need
gauge     triquad_held_out_median_metres       status.fit.median_m                                  Median of how far from zero the field is where rays end that it is not trained on
gauge     triquad_settled                      status.settled                                       1 where nothing is left to learn and the newest epoch shows all; else 0
gauge     triquad_loss                         status.loss                                          Recent training loss
counter   triquad_mapper_seconds_total         metrics.mapper_s.{activity}                          Time of the thread that maps, by activity
gauge     triquad_map_memory_bytes             status.map_bytes                                     Memory of the regions in it, with their rays and the newest epoch
gauge     triquad_map_memory_limit_bytes       status.map_max_bytes                                 Memory that the server may take in all
gauge     triquad_resident_memory_bytes        metrics.resident_bytes                               Memory of the process, with its libraries
counter   triquad_checkpoints_total            metrics.checkpoints.{outcome:written+failed}         Checkpoints by outcome
gauge     triquad_checkpoint_duration_seconds  metrics.checkpoints.last_duration_s                  How long writing the last checkpoint took
gauge     triquad_checkpoint_age_seconds       metrics.checkpoints.age_s                            Time since the last checkpoint of this process was written
gauge     triquad_checkpoint_late_seconds      metrics.checkpoints.late_s                           For how long more is unsaved than two periods
gauge     triquad_checkpoint_bytes             status.last_checkpoint.bytes                         Size of the last checkpoint with all its parts
"""  # noqa: E501

_KINDS = {
    "gauge": core.GaugeMetricFamily,
    "counter": core.CounterMetricFamily,
    "histogram": core.HistogramMetricFamily,
}


class Family(NamedTuple):
    """A metric, as a row of the table."""

    kind: str
    name: str
    place: str
    meaning: str

    @property
    def labels(self) -> list[str]:
        """The names of its labels."""
        return ["map", *re.findall(r"{(\w+)", self.place)]


FAMILIES = tuple(Family(*row.split(maxsplit=3)) for row in _TABLE.strip().splitlines())


@dataclass(frozen=True)
class Figures:
    """All that is known of a map at one time: its two messages, and what follows from them."""

    status: ServerStatus
    metrics: ServerMetrics

    @property
    def healthy(self) -> bool:
        """Whether the server does all that it should."""
        return self.metrics.problem is None

    @property
    def info(self) -> dict[str, Any]:
        """The value 1 below the words that tell which server this is."""
        status = self.status
        return {status.server: {status.version: {status.device: 1}}}

    @property
    def operations(self) -> dict[str, OperationMetrics]:
        """The operations that were ever asked for."""
        return {name: one for name, one in self.metrics.operations.items() if one.received_bytes}

    @property
    def sessions(self) -> Counter[str]:
        """How many sessions of Zenoh of each kind are connected."""
        return Counter(self.metrics.sessions.values())


@dataclass(frozen=True)
class _Exposition(Collector):
    """The metrics of all maps."""

    maps: Sequence[Figures]

    def collect(self) -> Iterator[core.Metric]:
        """Make all metrics of the table."""
        for family in FAMILIES:
            metric = _KINDS[family.kind](family.name, family.meaning, labels=family.labels)
            for figures in self.maps:
                _add(metric, family, figures)
            yield metric


def exposition(maps: Sequence[Figures]) -> str:
    """Return the metrics of all maps in Prometheus' text format."""
    return generate_latest(_Exposition(maps)).decode()


def _add(metric: Any, family: Family, figures: Figures) -> None:
    """Add what a metric says of a map."""
    bounds = [*map(str, figures.metrics.bounds_s.tolist()), "+Inf"]
    for labels, value in _values(figures, family.place.split(".")):
        labels = (figures.status.map_name, *labels)
        if isinstance(value, TimeHistogram):
            buckets = list(zip(bounds, np.cumsum(value.counts).tolist(), strict=True))
            metric.add_metric(labels, buckets, value.sum_s)
        else:
            metric.add_metric(labels, value)


def _values(value: Any, place: Sequence[str]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield labels and values at a place; nothing where a field on the way is ``None``."""
    if value is None:
        return
    if not place:
        yield (), value
    elif not place[0].startswith("{"):
        yield from _values(getattr(value, place[0]), place[1:])
    else:
        _, _, fields = place[0].strip("{}").partition(":")
        named = {field: getattr(value, field) for field in fields.split("+")} if fields else value
        for name, inner in named.items():
            for labels, found in _values(inner, place[1:]):
                yield (name, *labels), found
