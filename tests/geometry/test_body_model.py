"""The body that is fitted, against the simulated person who has the same mesh."""

import numpy as np
import pytest

from pipelines.geometry.body_model import MEAN_SHAPE, SHAPE, SHAPE_SIGMA, body_model, make_skin, shape_of
from pipelines.geometry.poses import quaternion_from_rotation_vector
from pipelines.geometry.rig import BONE, BONES, BodyMotion, joint_centres
from pipelines.simulation.body import _undressed, make_body
from pipelines.simulation.scenario import Body

STILL = np.tile([0.0, 0.0, 0.0, 1.0], (len(BONES), 1))


@pytest.mark.parametrize(("sex", "build"), [("female", "slim"), ("male", "heavy")])
def test_a_simulated_person_has_a_shape_and_rotations_in_the_model(sex: str, build: str) -> None:
    look = Body.model_validate({"sex": sex, "build": build, "height_m": 1.7})
    person, bare, model = make_body(look), _undressed(look), body_model()
    turns = np.random.default_rng(0).normal(0.0, 0.4, (1, len(BONES), 3))
    motion = BodyMotion(np.zeros(1), np.array([[1.0, 2.0, 0.9]]), quaternion_from_rotation_vector(turns))
    rotation, shape = model.rotations(person.world_from_rest(motion))[0], shape_of(sex, build, 1.7)
    centre = joint_centres(person.rig, motion)[0]
    step = model.steps[:, BONE["left_shank"]] * shape[0]
    assert np.linalg.norm(np.array([1.0, *shape[1:]]) @ step) == pytest.approx(
        np.linalg.norm(centre[BONE["left_shank"]] - centre[BONE["left_thigh"]]), abs=0.004
    )
    made = model.surface(shape, motion.root[0], rotation)
    whole = make_skin(bare.vertices, bare.weights)
    true = whole.moved(*person.skinning.transforms(motion.root[0], motion.rotation[0]))
    # Every vertex of the model is one of the person's; the fifth principal mode, 2 mm, is left out.
    away = np.sqrt(((made[::40, None] - true[None]) ** 2).sum(axis=-1)).min(axis=1)
    assert np.sqrt(np.mean(away**2)) < 0.004


def test_every_number_of_the_shape_keeps_the_stature() -> None:
    model = body_model()
    for number in range(len(SHAPE)):
        shape = MEAN_SHAPE + SHAPE_SIGMA * (np.arange(len(SHAPE)) == number)
        surface = model.surface(shape, np.zeros(3), STILL)
        feet = surface[model.weights[:, BONE["left_foot"]] > 0.9, 2].min()
        # The suit stands off the soles and the crown is bare: 1 % of the height.
        assert surface[:, 2].max() - feet == pytest.approx(shape[0], rel=0.012), SHAPE[number]
