"""Contents of MCAP recordings that this project's reader ignores, although an MCAP viewer shows
them."""

from collections import Counter
from pathlib import Path

from mcap import records

from ssm_study.data.mcap import METADATA_NAME, read_mcap
from ssm_study.data.mcap_records import iterate_mcap_records


def list_unread_contents(path: Path) -> list[str]:
    """Names of everything in an MCAP recording that this project's reader ignores, such as
    attachments.

    Attachments, further metadata records, topics without numbers, a topic that occurs twice: a
    viewer would show them as parts of the recording.
    """
    groups, _ = read_mcap(path)
    topics = {group.topic for group in groups}
    topics |= {topic.rpartition("/")[0] for topic in topics}
    foreign = list[str]()
    channels = dict[int, str]()
    metadata = list[str]()
    for record in iterate_mcap_records(path, with_messages=False):
        if isinstance(record, records.Attachment):
            foreign.append(f"attachment {record.name}")
        elif isinstance(record, records.Metadata):
            metadata.append(record.name)
        elif isinstance(record, records.Channel):
            channels[record.id] = record.topic
    unread = [topic for topic in channels.values() if topic not in topics]
    repeated = [topic for topic, count in Counter(channels.values()).items() if count > 1]
    foreign += [f"topic {topic}" for topic in (*unread, *repeated)]
    if METADATA_NAME in metadata:
        metadata.remove(METADATA_NAME)
    foreign += [f"metadata {name}" for name in metadata]
    return sorted(set(foreign))
