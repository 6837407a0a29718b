"""Descriptor of the UDP backend; levid imports the parts when it needs them."""

from levid.config.backends import BackendDescriptor

DESCRIPTOR = BackendDescriptor(
    backend="levid_udp.backend:UdpBackend",
    bus="levid_udp.bus:UdpBus",
    options={
        "amplifiers": "levid.config.buses:AmplifierOptions",
        "sensors": "levid.config.buses:SensorOptions",
        "drives": "levid.config.buses:SerialDriveOptions",
    },
    bus_time="levid_udp.bus:bus_time",
    emulator="levid_udp.emulator:UdpElectronics",
)
