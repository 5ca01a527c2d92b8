# The README's steps in a container. No container engine has tried this file; workflow/try_fresh.sh runs the same lines.
FROM debian:bookworm-slim AS system
COPY apt.txt .
RUN apt-get update && apt-get install -y --no-install-recommends $(cat apt.txt) && rm -rf /var/lib/apt/lists/*

FROM system
WORKDIR /srv
COPY . radar-on-lidar
WORKDIR radar-on-lidar
RUN make setup
CMD ["make", "book"]
