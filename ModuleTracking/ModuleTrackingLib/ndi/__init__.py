"""NDI's Combined API: a protocol core without input or output, the port around it, and an emulated device.

`crc`, `words`, `replies`, `tracking` and `encode` turn bytes into values and back; `steps` and `session`
hold the conversation as scripts that ask for bytes; `conductor` plays a script on a port; `serial_port` is
the only file that knows pyserial. The emulator stands on the same core.
"""
