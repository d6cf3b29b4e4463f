# The same Debian packages as ./with-fenicsx, and the remodel-fenicsx command.  docs/start.md tells more.
#   docker build -t remodel-fenicsx .
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" remodel-fenicsx run demos/artery.toml

# what ./with-fenicsx runs its commands in when it finds only a container engine: the packages, without the project
FROM debian:trixie-slim AS environment
COPY environment/debian-packages.txt /usr/local/share/remodel-fenicsx/debian-packages.txt
RUN apt-get update \
    && sed -e 's/#.*//' /usr/local/share/remodel-fenicsx/debian-packages.txt \
       | DEBIAN_FRONTEND=noninteractive xargs apt-get install --yes --no-install-recommends \
    && rm -rf /var/lib/apt/lists/*
ENV LANG=C.UTF-8 OMPI_MCA_btl=self,sm OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1

FROM environment
LABEL org.opencontainers.image.title="remodel-fenicsx" \
      org.opencontainers.image.description="Remodeling of collagen in living tissue, in FEniCSx" \
      org.opencontainers.image.version="0.5.0" \
      org.opencontainers.image.licenses="MIT"
COPY . /opt/remodel-fenicsx
ENV PATH=/opt/remodel-fenicsx/bin:$PATH PYTHONPATH=/opt/remodel-fenicsx HOME=/home/remodel
# --user makes the results the caller's own; home, where compiled forms are kept, is anybody's then
RUN python3 -m compileall -q /opt/remodel-fenicsx/remodel_fenicsx \
    && useradd --create-home --uid 1000 remodel \
    && mkdir -p /data && chmod 1777 /home/remodel /data
USER remodel
# what the demos compile, for this kind of processor: one step of each
RUN for scene in /opt/remodel-fenicsx/demos/*.toml; do \
        remodel-fenicsx run "$scene" --set time.end=1 --set time.step=1 --set "output.times=[]" --no-report --quiet \
            -o "/tmp/demos/$(basename "$scene")" || exit 1; \
    done \
    && rm -rf /tmp/demos && chmod -R a+rwX /home/remodel/.cache
WORKDIR /data
ENTRYPOINT ["remodel-fenicsx"]
CMD ["--help"]
