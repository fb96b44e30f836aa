"""Tags, reverts and blame, in whatever database a map lies."""

from __future__ import annotations

import dataclasses

import pytest

from engram.errors import InputError, RevisionError
from engram.graph.model import EdgeKind, PathEntry, PathEntryKind, path_id
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.maps.records import SessionState

from .frames import assert_same_landmarks
from .maps import Drive, assert_same_edges, begin, edge, node_frame, session, write_drive
from .test_map_store import assert_holds


@pytest.fixture
def store(location):
    with Map.create(location) as store:
        yield store


@pytest.fixture
def two(store) -> list[Drive]:
    """Two revisions; the second one's edge hangs on a node of the first."""
    drives = []
    for number in (1, 2):
        writer = begin(store, session(f"robot-{number}"))
        drives.append(write_drive(writer, 3))
        if number == 2:
            tie = edge(drives[0].nodes[1].id, drives[1].nodes[0].id, EdgeKind.TIE, seed=40)
            writer.add_edge(tie)
            drives[1].edges.append(tie)
        writer.commit()
    return drives


def map_again(store: Map, drive: Drive, count: int = 3) -> Drive:
    """The same drive, handed in again."""
    writer = begin(store, drive.session)
    again = write_drive(writer, count)
    writer.commit()
    return again


class TestTags:
    def test_a_tag_names_a_revision_wherever_one_is_asked_for(self, store, two, location):
        store.tag("winter", 1, author="me", message="before the snow melted")
        for named, number in {
            "winter": 1, "1": 1, "head": 2, "HEAD": 2, "head~": 1, "head~1": 1, "head~2": 0,
            "winter~1": 0, 2: 2, None: 2,
        }.items():  # fmt: skip
            assert store.resolve(named) == number
        with Map.open(location, at="winter") as old:
            assert_holds(old, two[0])
            assert old.tags()["winter"].message == "before the snow melted"

    @pytest.mark.parametrize("named", ["summer", "", "-1", "3", "head~3", "winter~2", "1.5", "²"])
    def test_what_names_no_revision_is_refused(self, store, two, location, named):
        store.tag("winter", 1, author="me")
        with pytest.raises(RevisionError, match=r"winter|1 to 2"):
            Map.open(location, at=named)

    @pytest.mark.parametrize("name", ["", "7", "head", "Head", "a b", "a~1", "-x", "ž", "a" * 101])
    def test_what_could_be_taken_for_something_else_is_no_tag(self, store, two, name):
        with pytest.raises(InputError, match="cannot be a tag"):
            store.tag(name, author="me")

    def test_tags_move_only_when_told_and_can_be_taken_away(self, store, two):
        assert store.tag("live", 1, author="me").number == 1
        assert store.tag("live", 1, author="you").author == "me"
        with pytest.raises(RevisionError, match="tagged 'live' already"):
            store.tag("live", author="me")
        assert store.tag("live", author="me", move=True).number == 2
        assert store.untag("live", author="me").number == 2
        assert store.tags() == {}
        with pytest.raises(RevisionError, match="no tag 'live'"):
            store.untag("live", author="me")

    def test_tags_change_neither_history_nor_content(self, store, two, location):
        before = store.content_hash(), store.log()
        store.tag("live", 1, author="me")
        assert (store.content_hash(), store.log()) == before
        assert check_file(location).problems == ()

    def test_an_empty_map_has_nothing_to_tag(self, store):
        with pytest.raises(RevisionError, match="no revision yet"):
            store.tag("live", author="me")


class TestRevert:
    def test_what_a_revision_brought_is_gone_and_older_revisions_stay(self, store, two, location):
        hashes = []
        for at in (1, 2):
            with Map.open(location, at=at) as old:
                hashes.append(old.content_hash())
        done = store.revert(2, author="me", message="loose camera")
        assert done.revision.number == 3
        assert done.revision.message == "revert revision 2: loose camera"
        assert_holds(store, two[0])
        for at, drives in ((1, two[:1]), (2, two)):
            with Map.open(location, at=at) as old:
                assert_holds(old, *drives)
                assert old.content_hash() == hashes[at - 1]
        assert store.content_hash() not in hashes
        assert check_file(location).problems == ()

    def test_what_others_built_on_it_goes_with_it_and_is_counted(self, store, two):
        done = store.revert(1, author="me")
        assert done.lost_by_others == {"edges": 1, "path_entries": 0, "omissions": 0}
        contents = store.load()
        assert contents.nodes == tuple(two[1].nodes)
        assert_same_edges(contents.edges, two[1].edges[:-1])
        assert done.difference.old.nodes - done.difference.new.nodes == 3

    def test_reverting_the_revert_brings_all_of_it_back(self, store, two, location):
        store.revert(1, author="me")
        store.revert(3, author="me")
        assert_holds(store, *two)
        store.revert("head", author="me")
        assert store.load().nodes == tuple(two[1].nodes)
        assert check_file(location).problems == ()

    def test_what_others_get_back_is_counted_by_itself(self, store, two):
        nothing = {"edges": 0, "path_entries": 0, "omissions": 0}
        assert store.revert(1, author="me").regained_by_others == nothing
        undone = store.revert(3, author="me")
        assert undone.lost_by_others == nothing
        # The first drive's two edges and the second one's tie; all entries of the first.
        assert undone.regained_by_others == {"edges": 3, "path_entries": 3, "omissions": 0}

    def test_a_dry_run_tells_and_writes_nothing(self, store, two, location):
        before = store.content_hash()
        done = store.revert(1, author="me", dry_run=True)
        assert done.revision is None
        assert done.difference.new.nodes == 3
        assert (store.content_hash(), store.revision) == (before, 2)
        assert_holds(store, *two)

    def test_nothing_left_to_take_back_is_refused(self, store, two):
        store.revert(2, author="me")
        with pytest.raises(RevisionError, match="nothing to revert"):
            store.revert(2, author="me")
        for named in (0, 9, "summer"):
            with pytest.raises(RevisionError):
                store.revert(named, author="me")
        assert store.revision == 3

    def test_a_reverted_drive_may_be_mapped_again(self, store, two, location):
        store.revert(2, author="me")
        assert store.session_state(two[1].session.id) is SessionState.ABSENT
        again = map_again(store, two[1], count=4)
        assert_holds(store, two[0], again)
        assert store.log()[-1].contents["nodes"] == 1  # three came back, one is new
        assert store.session_state(two[1].session.id) is SessionState.COMMITTED
        for at, drives in ((2, two), (3, two[:1]), (4, [two[0], again])):
            with Map.open(location, at=at) as old:
                assert_holds(old, *drives)
        assert check_file(location).problems == ()

    def test_what_comes_back_goes_again_when_its_revision_is_reverted(self, store, two):
        store.revert(2, author="me")
        map_again(store, two[1])
        store.revert("head", author="me")
        assert_holds(store, two[0])

    def test_a_drive_that_comes_back_can_be_interrupted_and_resumed(self, store, two, location):
        store.revert(2, author="me")
        writer = begin(store, two[1].session)
        write_drive(writer, 2)
        writer.checkpoint()
        assert_same_landmarks(
            store.frames.frame(two[1].nodes[0].id).landmarks,
            two[1].frames[two[1].nodes[0].id].landmarks,
        )
        store.close()
        with Map.open(location, writes=True) as again:
            (left,) = again.interrupted()
            assert (left.session, left.nodes) == (two[1].session, 2)
            assert check_file(location).interrupted == (two[1].session.id,)
            with pytest.raises(RevisionError, match="resume"):
                begin(again, two[1].session)
            resumed = again.resume_session(two[1].session.id)
            assert (len(resumed.stored.nodes), resumed.stored.next_sequence) == (2, 2)
            drive = Drive(two[1].session, two[1].nodes[:2])
            drive.write_node(resumed, 2)
            resumed.commit()
            assert {node.id for node in again.load().nodes} == {
                node.id for one in two for node in one.nodes
            }
        assert check_file(location).problems == ()

    def test_a_drive_may_come_back_only_as_what_it_was(self, store, two):
        store.revert(2, author="me")
        elsewhere = dataclasses.replace(two[1].session, longitude_deg=-3.0)
        with pytest.raises(InputError, match=r"longitude_deg 14\.4, now -3\.0"):
            begin(store, elsewhere)
        writer = begin(store, two[1].session)
        first = two[1].nodes[0]
        with pytest.raises(InputError, match="other landmarks"):
            writer.add_node(first, node_frame(two[1].session, 0, count=7))

    def test_a_session_that_later_revisions_added_to_keeps_its_name(self, store, two, location):
        with store.begin_revision(author="me", message="more", configuration={}) as bulk:
            tie = edge(two[0].nodes[0].id, two[1].nodes[1].id, EdgeKind.MATCH, seed=9)
            bulk.add_edge(tie)
            bulk.commit()
        store.revert(1, author="me")
        # The match hangs on a node that is gone; the second session stands by itself.
        assert store.load().sessions == (two[1].session,)
        assert_same_edges(store.load().edges, two[1].edges[:-1])

    def test_an_entry_that_was_superseded_is_not_counted(self, store, two):
        nodes = two[0].nodes[0], two[1].nodes[0]
        # Written again where nobody saw it, since its node was hidden; then both can be seen.
        for at, node in enumerate(nodes):
            if at:
                store.revert(1, author="me")
            with store.begin_revision(author="me", message="more", configuration={}) as bulk:
                path, kind = path_id(two[1].session.id), PathEntryKind.MATCHED
                bulk.add_path_entry(PathEntry(path, 9, node.id, kind, node.stamp_ns))
                bulk.commit()
        store.revert(4, author="me")
        entries = store.load().path_entries
        assert [one.node for one in entries if one.sequence == 9] == [nodes[1].id]
        assert store.info().path_entries == len(entries) == 7

    def test_not_while_a_session_is_written(self, store, two):
        begin(store, session("robot-3"))
        with pytest.raises(RevisionError, match="being written"):
            store.revert(1, author="me")


class TestContentHashWithHistory:
    def test_the_same_steps_give_the_same_hash(self, store, two, tmp_path):
        store.revert(2, author="me")
        map_again(store, two[1])
        with Map.create(tmp_path / "other.engram") as other:
            for number in (1, 2):
                writer = begin(other, session(f"robot-{number}"))
                drive = Drive(writer.session)
                for index in range(3):
                    drive.write_node(writer, index)
                    writer.checkpoint()
                if number == 2:
                    writer.add_edge(two[1].edges[-1])
                writer.commit()
            other.tag("noise", author="me")
            other.revert(2, author="me")
            map_again(other, two[1])
            assert other.content_hash() == store.content_hash()


class TestBlame:
    def test_a_node_tells_its_revision_and_what_became_of_it(self, store, two):
        wanted = two[1].nodes[1]
        store.revert(2, author="me")
        origin = store.origin(str(wanted.id)[:13].upper())
        assert (origin.node, origin.session, origin.robot) == (
            wanted.id, two[1].session.id, "robot-2",
        )  # fmt: skip
        assert (origin.brought, origin.told, origin.visible) == (2, ((3, True),), False)

    def test_as_of_an_older_revision(self, store, two, location):
        store.revert(2, author="me")
        with Map.open(location, at=2) as old:
            assert old.origin(str(two[1].nodes[0].id)).visible
        with Map.open(location, at=1) as old, pytest.raises(InputError, match="none of"):
            old.origin(str(two[1].nodes[0].id))

    def test_a_prefix_of_several_nodes_lists_them(self, store, location):
        writer = begin(store, session())
        drive = write_drive(writer, 20)  # 20 UUIDs, 16 first digits: two begin alike
        writer.commit()
        firsts = [str(node.id)[0] for node in drive.nodes]
        twice = next(digit for digit in firsts if firsts.count(digit) > 1)
        with pytest.raises(
            InputError, match=rf"nodes begin with '{twice}', give more characters: {twice}"
        ):
            store.origin(twice)

    @pytest.mark.parametrize("prefix", ["", "-", "xyz", "0" * 33])
    def test_what_is_no_uuid_is_refused(self, store, two, prefix):
        with pytest.raises(InputError, match="is not a UUID"):
            store.origin(prefix)
