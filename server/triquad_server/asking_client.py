"""Which client the request is of that a thread is answering."""

from contextvars import ContextVar

asking_client: ContextVar[str] = ContextVar("asking_client", default="")
"""A name of the client; empty for all that are not told apart."""
