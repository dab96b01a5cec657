"""What is published arrives as it was, and what is missing is not published."""

from __future__ import annotations

import time
from contextlib import closing

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.openigtlink import IgtlClient, IgtlServer
from CranioNavLib.openigtlink.messages import Image, Status, Transform
from CranioNavLib.rigid import invert_rigid
from ModuleTrackingLib.plugins.openigtlink import OpenIGTLinkSettings, OpenIGTLinkTracker
from ModuleTrackingLib.publisher import Publisher
from scripted_tracker import a_pose, missing, ok, wait_until


@pytest.fixture
def a_server():
    with IgtlServer(port=0, status_interval_s=0.1) as server:
        yield server


@pytest.fixture
def a_client(a_server):
    with closing(IgtlClient(port=a_server.port)) as client:
        client.receive(0.05)
        wait_until(lambda: a_server.clients)
        yield client


def messages(client, seconds=0.3):
    found = []
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        found += client.receive(0.05)
    return found


def frame(probe=True):
    now = time.monotonic()
    poses = {"Reference": ok("Reference", a_pose(2), now), "Probe": ok("Probe", a_pose(1), now)}
    if not probe:
        poses["Probe"] = missing("Probe", now)
    return poses


def test_poses_go_out_in_both_frames_with_the_time_they_were_taken(a_server, a_client):
    Publisher(a_server).publish_poses(frame())
    transforms = {message.device: message for message in messages(a_client) if isinstance(message, Transform)}
    assert transforms.keys() == {"ProbeToReference", "ProbeToTracker", "ReferenceToTracker"}
    np.testing.assert_allclose(transforms["ProbeToReference"].matrix, invert_rigid(a_pose(2)) @ a_pose(1), atol=1e-4)
    assert transforms["ProbeToReference"].time_s == pytest.approx(time.time(), abs=5)


def test_a_missing_tool_is_not_sent_but_told(a_server, a_client):
    publisher = Publisher(a_server)
    publisher.publish_poses(frame())
    messages(a_client)
    publisher.publish_poses(frame(probe=False))
    found = messages(a_client)
    assert {message.device for message in found if isinstance(message, Transform)} == {"ReferenceToTracker"}
    told = [message for message in found if isinstance(message, Status)]
    assert told[-1].code == 4  # the first may be a keep-alive from before, still on its way
    assert "ProbeToReference MISSING" in told[-1].text


def test_a_registration_and_a_line_go_out(a_server, a_client):
    publisher = Publisher(a_server)
    publisher.publish_transform("ReferenceToRas", a_pose(3))
    publisher.publish_line(np.arange(100, dtype=np.int16), time.monotonic(), 0.02)
    found = messages(a_client)
    np.testing.assert_allclose(next(m for m in found if isinstance(m, Transform)).matrix, a_pose(3), atol=1e-4)
    image = next(m for m in found if isinstance(m, Image))
    np.testing.assert_array_equal(image.voxels.ravel(), np.arange(100))
    assert image.ijk_to_ras[0, 0] == pytest.approx(0.02)


def test_a_matrix_that_is_not_rigid_is_not_published(a_server):
    with pytest.raises(InputError, match="ReferenceToRas"):
        Publisher(a_server).publish_transform("ReferenceToRas", 2 * np.eye(4))


def test_our_own_tracker_plugin_takes_what_we_publish(a_server):
    publisher = Publisher(a_server)
    settings = OpenIGTLinkSettings(port=a_server.port, request_tdata=False, connect_timeout_s=0.2)
    with OpenIGTLinkTracker(settings) as tracker:
        wait_until(lambda: a_server.clients)
        publisher.publish_poses(frame())
        found = {}
        wait_until(lambda: found.update({pose.tool: pose for pose in tracker.read(0.1)}) or len(found) == 2)
        np.testing.assert_allclose(found["Probe"].tool_to_tracker, a_pose(1), atol=1e-4)
