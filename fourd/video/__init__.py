"""Video files: exact frame times, displayed RGB frames, H.264 films.

Times are those of the container (presentation, seconds, exact to its clock tick). Pictures are as
displayed: turned as the file says, with square pixels, 8-bit SDR. Only this package and
`fourd.audio` use PyAV.
"""

from fourd.video.encode import encode_video
from fourd.video.probe import VideoInfo, probe_video
from fourd.video.reader import VideoReader, read_video_frames
from fourd.video.times import nominal_fps

__all__ = ["VideoInfo", "VideoReader", "encode_video", "nominal_fps", "probe_video", "read_video_frames"]
