# Neurosim on a CPU, without a display:
#   docker build -t neurosim . && docker run --rm -v "$PWD:/work" neurosim run --out flight
# With a GPU: docker run --gpus all (the driver is the host's; nothing of CUDA has to be in the image).
FROM python:3.12-slim AS build
RUN apt-get update && apt-get install -y --no-install-recommends gcc libc6-dev && rm -rf /var/lib/apt/lists/*
COPY . /src
RUN pip wheel --no-cache-dir --no-deps -w /wheels /src

FROM python:3.12-slim
COPY --from=build /wheels /wheels
RUN pip install --no-cache-dir "$(ls /wheels/*.whl)[view,record,log,video,ros2]" && rm -r /wheels
ENV WARP_CACHE_PATH=/var/cache/warp
RUN mkdir -m 1777 /var/cache/warp && neurosim run --duration 0.05 --device cpu --out /tmp/first && rm -r /tmp/first
WORKDIR /work
ENTRYPOINT ["neurosim"]
CMD ["--help"]
