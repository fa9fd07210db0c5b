#!/usr/bin/env python3
"""Prints pose samples as JSON, one a line, with nothing but the stock Python package iceoryx2 0.10.

    pose_tail.py [--camera NAME] [--count N] [--timeout SECONDS] [--root FOLDER --prefix PREFIX]

Exit codes: 0 done, 69 no daemon, 75 timed out.
"""

import argparse
import ctypes
import json
import math
import sys
import time

import iceoryx2 as iox2

import grnet_messages as messages


def numbers(values):
    """A list of numbers, or None when one of them is not known."""
    values = list(values)
    return values if all(math.isfinite(value) for value in values) else None


def pose(field):
    """A pose as JSON, None when it is not known."""
    translation, quaternion = numbers(field.translation_m), numbers(field.quaternion_xyzw)
    if translation is None or quaternion is None:
        return None
    return {
        "translation_m": translation,
        "quaternion_xyzw": quaternion,
        "covariance_upper": numbers(field.covariance_upper),
    }


def as_json(sample):
    """One sample as a JSON object."""
    return {
        "schema_version": sample.schema_version,
        "boot_id": bytes(sample.boot_id).hex(),
        "camera": messages.text(sample.camera),
        "sample": sample.sample,
        "sequence": None if sample.sequence == messages.UNKNOWN_U64 else sample.sequence,
        "status": messages.name(messages.STATUS, sample.status),
        "reason": messages.name(messages.REASON, sample.reason),
        "capture_clock": messages.name(messages.CAPTURE_CLOCK, sample.capture_clock),
        "capture_time_ns": None if sample.capture_time_ns == messages.UNKNOWN_U64 else sample.capture_time_ns,
        "publish_time_ns": sample.publish_time_ns,
        "realtime_offset_ns": sample.realtime_offset_ns,
        "dropped_frames": sample.dropped_frames,
        "reset_epoch": sample.reset_epoch,
        "map_from_base": pose(sample.map_from_base),
        "odom_from_base": pose(sample.odom_from_base),
        "previous_from_current": pose(sample.previous_from_current),
    }


def configuration(root, prefix):
    """iceoryx2's own configuration, moved to another root where the daemon is."""
    config = iox2.config.global_config()
    if root:
        config.global_cfg.root_path = iox2.Path.new(root)
    if prefix:
        config.global_cfg.prefix = iox2.FileName.new(prefix)
    return config


def main():
    """Prints samples until there are enough or the time is up."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--camera", default="front")
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--timeout", type=float, default=10.0)
    parser.add_argument("--root")
    parser.add_argument("--prefix")
    args = parser.parse_args()

    iox2.set_log_level(iox2.LogLevel.Fatal)
    node = (
        iox2.NodeBuilder.new()
        .config(configuration(args.root, args.prefix))
        .signal_handling_mode(iox2.SignalHandlingMode.Disabled)
        .create(iox2.ServiceType.Ipc)
    )
    name = f"grnet/{args.camera}/pose"
    service_name = iox2.ServiceName.new(name)
    try:
        service = node.service_builder(service_name).publish_subscribe(messages.PoseSample).open()
        events = node.service_builder(service_name).event().open()
    except (iox2.PublishSubscribeOpenError, iox2.EventOpenError) as error:
        print(f"pose_tail.py: no grnetd publishes {name}: {error}; start grnetd", file=sys.stderr)
        return 69
    subscriber = service.subscriber_builder().create()
    listener = events.listener_builder().create()

    deadline = time.monotonic() + args.timeout
    printed = 0
    while printed < args.count:
        received = subscriber.receive()
        if received is not None:
            # A copy: the chunk goes back to the daemon.
            size = ctypes.sizeof(messages.PoseSample)
            sample = messages.PoseSample.from_buffer_copy(ctypes.string_at(received.payload(), size))
            received.delete()
            print(json.dumps(as_json(sample)), flush=True)
            printed += 1
            continue
        remaining = deadline - time.monotonic()
        if remaining <= 0:
            print(f"pose_tail.py: {name} gave {printed} of {args.count} samples in {args.timeout} s", file=sys.stderr)
            return 75
        listener.timed_wait(iox2.Duration.from_millis(max(1, int(remaining * 1000))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
