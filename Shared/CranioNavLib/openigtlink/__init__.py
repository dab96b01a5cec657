"""OpenIGTLink: messages, their bytes (no sockets needed), a client and a server.

Version 1 headers unless the peer speaks version 2; every body's CRC is checked; loopback unless told otherwise.
"""

from __future__ import annotations

from CranioNavLib.openigtlink.client import IgtlClient
from CranioNavLib.openigtlink.codec import Decoder, StreamError, encode
from CranioNavLib.openigtlink.server import IgtlServer

DEFAULT_PORT = 18944

__all__ = ["DEFAULT_PORT", "Decoder", "IgtlClient", "IgtlServer", "StreamError", "encode"]
