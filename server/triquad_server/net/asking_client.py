"""Which client the request is of that a thread is answering.

It goes beside the calls, and not through all of them, for only the pins of epochs go by it.
"""

from contextvars import ContextVar

asking_client: ContextVar[str] = ContextVar("asking_client", default="")
"""A name of the client; empty for all that are not told apart."""
