# A scene with its live page, in a container:
#
#     docker build -t sparseskin .
#     docker run --rm --init -p 127.0.0.1:8470:8471 sparseskin
#
# The second command prints the address of the page. Other commands: docker run --rm sparseskin sparseskin --help
FROM debian:bookworm-slim

# Further packages of Debian, such as the compilers that a dev container has.
ARG PACKAGES=""
RUN apt-get update \
    && apt-get install --yes --no-install-recommends make python3 python3-venv socat $PACKAGES \
    && rm -rf /var/lib/apt/lists/*

RUN useradd --create-home skin
USER skin
WORKDIR /home/skin/sparseskin
COPY --chown=skin . .

# The compiled loops are part of the image, so that the first frame does not wait for them.
RUN make .venv/compiled
ENV PATH="/home/skin/sparseskin/.venv/bin:$PATH"

# The page listens on port 8470 of the container's loopback interface, which Docker does not forward
# to. So port 8471 of its other interfaces leads there. Each page that is closed would be an error line.
EXPOSE 8471
CMD socat TCP-LISTEN:8471,fork,reuseaddr TCP:127.0.0.1:8470 2> /dev/null & \
    exec sparseskin launch drag_wrench_64 --set sensor.rate_hz=100 --set sensor.loop=true
