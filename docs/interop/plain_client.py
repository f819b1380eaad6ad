"""A client of cable.v1, from proto/cable/v1/perception.proto alone: ``python plain_client.py HOST:PORT PICTURE...``"""

import asyncio
import sys

import cv2
import grpc
from bitmap import decode_bitmap
from cable.v1 import perception_pb2 as pb
from cable.v1 import perception_pb2_grpc as pb_grpc


async def heard(call, within_s: float = 10.0):
    """The next message; 10 s of silence mean that the connection is lost (R7)."""
    response = await asyncio.wait_for(call.read(), within_s)
    if response is grpc.aio.EOF:
        sys.exit("the server ended the call")
    if response.WhichOneof("payload") == "closing":
        await call.done_writing()  # nothing more is sent, and the server ends the call with OK (R6)
        sys.exit(f"closed: {response.closing.status.message} ({pb.CloseAction.Name(response.closing.action)})")
    return response


def show(picture: str, result: pb.Result) -> None:
    """Prints an answer."""
    for box in result.detections:
        corners = f"{box.x_min:.0f},{box.y_min:.0f} to {box.x_max:.0f},{box.y_max:.0f}"
        print(f"{picture}: class {box.class_id}, score {box.score:.2f}, {corners}")
    if result.HasField("mask"):
        rows = decode_bitmap(result.mask.data, result.mask.height, result.mask.width)
        print(f"{picture}: mask of {sum(map(sum, rows))} pixels")


async def main(target: str, pictures: list[str]) -> None:
    """One session: Hello, Welcome, the pictures one by one, Goodbye."""
    images = [cv2.imread(picture) for picture in pictures]
    height, width = images[0].shape[:2]  # all of one camera
    async with grpc.aio.insecure_channel(target) as channel:
        call = pb_grpc.PerceptionServiceStub(channel).StreamPerception()
        hello = pb.Hello(protocol_revision=1, codec_config={"codec": "CODEC_JPEG", "width": width, "height": height})
        await call.write(pb.StreamPerceptionRequest(hello=hello))
        welcome = (await heard(call, 3.0)).welcome  # no frame before it (R1)
        print(f"{target}: {', '.join(model.name for model in welcome.models)}")
        for sequence, (picture, image) in enumerate(zip(pictures, images, strict=True)):
            frame = pb.VideoFrame(sequence=sequence, data=cv2.imencode(".jpg", image)[1].tobytes(), keyframe=True)
            await call.write(pb.StreamPerceptionRequest(frame=frame))
            # One frame is unanswered at a time, which every credit allows (R2); heartbeats may come between.
            while (kind := (response := await heard(call)).WhichOneof("payload")) not in ("result", "frame_rejected"):
                pass
            if kind == "result":
                show(picture, response.result)
            else:
                print(f"{picture}: rejected, {response.frame_rejected.message}")
        await call.write(pb.StreamPerceptionRequest(goodbye=pb.Goodbye()))
        await call.done_writing()
        await asyncio.wait_for(call.code(), 5.0)  # OK: all is answered


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], sys.argv[2:]))
