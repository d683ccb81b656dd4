# A scene with its live page, in a container:
#
#     docker build -t sparseskin .
#     docker run --rm --init -p 127.0.0.1:8470:8470 sparseskin
#
# The second command prints the address of the page. Other commands: docker run --rm sparseskin sparseskin --help
FROM debian:bookworm-slim

RUN apt-get update \
    && apt-get install --yes --no-install-recommends make python3 python3-venv socat \
    && rm -rf /var/lib/apt/lists/*

RUN useradd --create-home skin
USER skin
WORKDIR /home/skin/sparseskin
COPY --chown=skin . .

# The compiled loops are part of the image, so that the first frame does not wait for them.
RUN make .venv/compiled
ENV PATH="/home/skin/sparseskin/.venv/bin:$PATH"

# The page listens on the loopback interface of the container. Docker forwards to its other one.
EXPOSE 8470
CMD socat "TCP-LISTEN:8470,fork,bind=$(hostname -i)" TCP:127.0.0.1:8470 & \
    exec sparseskin launch drag_wrench_64 --set sensor.rate_hz=100 --set sensor.loop=true
