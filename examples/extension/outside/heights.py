"""How high every joint was on the average, as a text file."""

import numpy as np

from pipelines.session.errors import DataError


class Heights:
    name, title = "heights", "mean height of every joint of the first person, text"

    def write(self, recording, folder):
        motion = recording.motion
        if motion is None:
            raise DataError(recording.name, "holds no joints", "run `mocap reconstruct` first")
        mean = np.nanmean(motion.position[:, 0, :, 2], axis=0)
        path = folder / "heights.txt"
        path.write_text("".join(f"{joint} {z:.3f}\n" for joint, z in zip(motion.joints, mean, strict=True)))
        return [path]


EXPORT = Heights()
