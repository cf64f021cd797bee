"""Script that makes reference_blazepose.json with MediaPipe itself.

It needs its own environment, because mediapipe 0.10.21 is not compatible with ours:

    python3.11 -m venv /tmp/reference && /tmp/reference/bin/pip install mediapipe==0.10.21
    /tmp/reference/bin/python tools/reference_blazepose.py FOLDER_OF_VIDEOS

The videos are those of the Pose2Sim single-person demo (BSD-3), as they come in its package.
"""

import hashlib
import json
import sys
from pathlib import Path
from typing import Any

import cv2
import mediapipe  # type: ignore[import-not-found]  # lives in an environment of its own
import numpy as np
from mediapipe.python.solution_base import SolutionBase  # type: ignore[import-not-found]

# Not cam02.mp4: OpenCV 4 and 5 turn its pixels into other colours.
VIDEOS = ("cam01.mp4", "cam03.mp4", "cam04.mp4")
FRAMES = (10, 30, 60, 90)
GRAPH = "mediapipe/modules/pose_landmark/pose_landmark_cpu.binarypb"
SETTINGS = {
    "model_complexity": 1,
    "smooth_landmarks": False,
    "enable_segmentation": False,
    "smooth_segmentation": False,
    "use_prev_landmarks": False,
}


def main(folder: Path) -> None:
    frames = [frame_of(folder / video, frame) for video in VIDEOS for frame in FRAMES]
    origin = {
        "made_by": "tools/reference_blazepose.py",
        "mediapipe": mediapipe.__version__,
        "graph": GRAPH,
        "settings": SETTINGS,
        "videos": "Pose2Sim single-person demo",
        "numbers": "MediaPipe's shares of the picture times its width or height; regions: x, y, side, angle",
    }
    lines = ",\n".join(json.dumps(frame) for frame in frames)
    target = Path(__file__).parents[1] / "tests" / "keypoints" / "reference_blazepose.json"
    target.write_text(f'{{"origin": {json.dumps(origin)},\n"frames": [\n{lines}\n]}}\n')


def frame_of(video: Path, number: int) -> dict[str, Any]:
    capture = cv2.VideoCapture(str(video))
    for _ in range(number + 1):
        ok, picture = capture.read()
        assert ok
    # A new graph for each picture: it filters the points that place the next region over time.
    with SolutionBase(
        binary_graph_path=GRAPH,
        side_inputs=SETTINGS,
        outputs=["pose_landmarks", "pose_detection", "pose_rect_from_detection", "pose_rect_from_landmarks"],
    ) as graph:
        found = graph.process({"image": np.ascontiguousarray(picture[:, :, ::-1])})
    height, width = picture.shape[:2]
    return {
        "video": video.name,
        "frame": number,
        "sha256": hashlib.sha256(picture.tobytes()).hexdigest(),
        "score": round(found.pose_detection.score[0], 6),
        "region": region(found.pose_rect_from_detection, width, height),
        "next_region": region(found.pose_rect_from_landmarks, width, height),
        "landmarks": [
            [round(one.x * width, 4), round(one.y * height, 4)] for one in found.pose_landmarks.landmark
        ],
    }


def region(rect: Any, width: int, height: int) -> list[float]:
    return [
        round(rect.x_center * width, 4),
        round(rect.y_center * height, 4),
        round(rect.width * width, 4),
        round(rect.rotation, 6),
    ]


if __name__ == "__main__":
    main(Path(sys.argv[1]))
