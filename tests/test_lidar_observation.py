import numpy as np
import pytest

from shepherd_phys.lidar import CHANNELS, Lidar, Scan
from shepherd_phys.observation import Stack, encode, observe, turn


def test_proximities_are_hand_worked():
    ranges = np.full((2, 1, 8), np.inf)
    ranges[0, 0, :3] = 0.0, 10.0, 49.0
    ranges[1, 0, 1] = 30.0
    scan = Scan(("sheep", "goal"), ranges)
    frame = encode(scan, Lidar(channels=("sheep", "goal"), beams=8))
    assert frame.dtype == np.float32
    assert frame[0] == pytest.approx(np.array([[1.0, 0.8, 0.02] + 5 * [0.0], [0.0, 0.6] + 6 * [0.0]]))
    # a channel that the scan does not have reads nothing
    more = encode(scan, Lidar(channels=CHANNELS, beams=8))
    assert np.array_equal(more[0, [0, 2]], frame[0])
    assert not more[0, [1, 3]].any()


def test_the_first_frame_fills_the_stack_and_the_stride_spreads_it():
    lidar = Lidar(channels=("sheep",), beams=8, stack=3, stack_stride=2)
    history = Stack(lidar)
    seen = []
    for k in range(7):
        history.push(np.full((2, 1, 8), k, np.float32))
        frames = history.frames()
        assert frames.shape == (2, 3, 1, 8)
        seen.append(frames[0, :, 0, 0].tolist())
    assert seen == [[0, 0, 0], [0, 0, 1], [0, 0, 2], [0, 1, 3], [0, 2, 4], [1, 3, 5], [2, 4, 6]]
    history.reset()
    history.push(np.full((2, 1, 8), 9, np.float32))
    assert history.frames()[1, :, 0, 0].tolist() == [9, 9, 9]


def frames_of(lidar, n_shepherds=2, seed=0):
    rng = np.random.default_rng(seed)
    shape = (n_shepherds, lidar.stack, len(lidar.channels), lidar.beams)
    return (rng.random(shape) * (rng.random(shape) < 0.5)).astype(np.float32)


def test_rows_are_frame_by_channel():
    lidar = Lidar(beams=16)
    frames = frames_of(lidar)
    observation, offset = observe(frames, np.zeros(2, int), lidar)
    assert observation.shape == lidar.observation_shape(2) == (2, 9, 16)
    assert observation.dtype == np.float32
    for frame in range(3):
        for channel in range(3):
            assert np.array_equal(observation[:, 3 * frame + channel], frames[:, frame, channel])
    assert not np.shares_memory(observation, frames)
    assert offset.tolist() == [0, 0]


@pytest.mark.parametrize("sectors", [None, 4])
def test_the_layout_of_the_paper_holds_the_same_numbers(sectors):
    rows = Lidar(beams=16, sectors=sectors)
    paper = rows.but(layout="paper")
    frames = frames_of(rows)
    a, _ = observe(frames, np.zeros(2, int), rows)
    b, _ = observe(frames, np.zeros(2, int), paper)
    columns = sectors or 16
    assert b.shape == paper.observation_shape(2) == (2, 3 * columns, 1, 3)
    for frame in range(3):
        assert np.array_equal(b[:, :, 0, frame], a[:, 3 * frame : 3 * frame + 3].reshape(2, -1))
    assert Lidar(layout="paper").observation_shape(1) == (1, 1536, 1, 3)
    assert not np.shares_memory(b, frames)


def test_sectors_keep_the_nearest_of_beams_round_their_middle():
    lidar = Lidar(channels=("sheep",), beams=512, sectors=64, stack=1)
    assert lidar.observation_shape(3) == (3, 1, 64)
    for beam, sector in ((0, 0), (3, 0), (4, 1), (508, 0), (507, 63), (511, 0), (8, 1), (11, 1), (12, 2)):
        frames = np.zeros((1, 1, 1, 512), np.float32)
        frames[..., beam] = 0.5
        frames[..., 8 * sector] += 0.1
        observation, _ = observe(frames, np.zeros(1, int), lidar)
        expected = np.zeros(64, np.float32)
        expected[sector] = frames.max()
        assert np.array_equal(observation[0, 0], expected)
    odd = Lidar(channels=("sheep",), beams=9, sectors=3, stack=1)
    beams = np.arange(1, 10, dtype=np.float32).reshape(1, 1, 1, 9)
    assert observe(beams, np.zeros(1, int), odd)[0][0, 0].tolist() == [9, 5, 8]


def goal_frames(lit, beams=16, stack=2):
    frames = np.zeros((1, stack, 2, beams), np.float32)
    frames[:, :, 0] = np.arange(beams)  # a sheep channel that tells its beams apart
    frames[:, -1, 1, list(lit)] = 0.5
    return frames


GOAL_FRAME = Lidar(channels=("sheep", "goal"), beams=16, stack=2, frame="goal")


@pytest.mark.parametrize(
    ("lit", "last", "expected"),
    [
        ((4,), 0, 4),
        ((3, 4, 5), 0, 4),
        ((15, 0, 1), 7, 0),  # the mean is circular
        ((14, 15), 0, None),  # half-way: either neighbour
        ((), 5, 5),  # nothing lit
        (range(16), 5, 5),  # standing inside
        (range(9), 5, 5),  # more than half: only from inside
        (range(1, 8), 5, 4),
        ((0, 8), 3, 3),  # no mean
    ],
)
def test_the_goal_frame_rolls_all_frames_to_the_goal(lit, last, expected):
    frames = goal_frames(lit)
    observation, offset = observe(frames, np.array([last]), GOAL_FRAME)
    if expected is None:
        assert offset[0] in (14, 15)
        return
    assert offset.tolist() == [expected]
    for row in range(4):
        assert np.array_equal(observation[0, row], np.roll(frames[0, row // 2, row % 2], -expected))
    # only the newest frame tells where the goal is
    frames[0, 0, 1, 11] = 1.0
    assert observe(frames, np.array([last]), GOAL_FRAME)[1].tolist() == [expected]


def test_sectors_come_after_the_roll():
    lidar = GOAL_FRAME.but(sectors=4)
    frames = goal_frames((5,))
    observation, offset = observe(frames, np.array([0]), lidar)
    rolled, _ = observe(frames, np.array([0]), GOAL_FRAME)
    assert offset.tolist() == [5]
    groups = np.roll(rolled, 2, axis=-1).reshape(1, 4, 4, 4).max(axis=-1)
    assert np.array_equal(observation, groups)
    assert observation[0, 3, 0] == 0.5


@pytest.mark.parametrize("frame", ["world", "goal"])
@pytest.mark.parametrize("sectors", [None, 16])
@pytest.mark.parametrize("layout", ["rows", "paper"])
def test_more_axes_in_front_and_the_stack_give_the_same(frame, sectors, layout):
    lidar = Lidar(beams=64, frame=frame, sectors=sectors, layout=layout)
    frames, last = frames_of(lidar, 6), np.arange(6)
    observation, offset = observe(frames, last, lidar)
    many, offsets = observe(frames.reshape(2, 3, *frames.shape[1:]), last.reshape(2, 3), lidar)
    assert np.array_equal(many.reshape(observation.shape), observation)
    assert np.array_equal(offsets.reshape(-1), offset)
    history = Stack(lidar)
    for k in range(3):
        history.push(frames[:, k])
    stacked, offset_too = history.observe(last)
    assert np.array_equal(stacked, observation)
    assert np.array_equal(offset_too, offset)
    assert not np.shares_memory(stacked, history.observe(last)[0])
    assert last.tolist() == list(range(6))


def test_actions_are_turned_back_by_the_same_angle():
    action = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 0.5]])
    turned = turn(action, np.array([0, 4, 8]), 16)
    assert turned == pytest.approx(np.array([[1.0, 0.0], [0.0, 1.0], [0.0, -0.5]]))
    assert turn(action.astype(np.float32), np.array([0, 4, 8]), 16).dtype == np.float32


@pytest.mark.parametrize("offset", [np.array([5]), np.arange(4), np.array(5), np.array([[5]] * 3)])
@pytest.mark.parametrize("shape", [(3, 2), (3, 1), (2,), (3, 2, 1)])
def test_a_turn_needs_as_many_offsets_as_vectors(shape, offset):
    with pytest.raises(ValueError, match=r"^action: needs the shape \(P, 2\)"):
        turn(np.ones(shape), offset, 16)
