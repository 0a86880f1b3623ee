# Runs the demonstration: docker build -t scene-envs . && docker run --rm -v "$PWD/runs:/scene-envs/runs" scene-envs
FROM python:3.11-slim-bookworm

RUN apt-get update && apt-get install -y --no-install-recommends make libgl1 libglib2.0-0 && rm -rf /var/lib/apt/lists/*
WORKDIR /scene-envs
COPY . .
RUN make install
CMD ["make", "demo"]
