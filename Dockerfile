# docker build -t stereo-vio . && docker run --rm -v "$PWD/out:/data" stereo-vio
# The default command is the demo; its results are in /data. Own recordings: docker run … -v /path:/data stereo-vio run /data/folder
FROM python:3.11-slim AS build
WORKDIR /src
COPY pyproject.toml setup.py constraints.txt README.md LICENSE ./
COPY vio vio
COPY frontend frontend
RUN python -m venv /opt/vio \
    && /opt/vio/bin/pip install --no-cache-dir -c constraints.txt .

FROM python:3.11-slim
# OpenCV's wheel needs glib, pycolmap's OpenMP.
RUN apt-get update && apt-get install -y --no-install-recommends libglib2.0-0 libgomp1 && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/vio /opt/vio
RUN useradd --create-home --uid 1000 vio && mkdir /data && chown vio /data
USER vio
WORKDIR /data
ENV PATH=/opt/vio/bin:$PATH PYTHONUNBUFFERED=1
# The loops are compiled once, into the user's cache, so that a container starts quickly.
RUN vio demo --out /tmp/demo && rm -rf /tmp/demo
ENTRYPOINT ["vio"]
CMD ["demo", "--out", "/data/demo"]
