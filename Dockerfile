# The same steps as on any machine: make install, hemislam serve.
#
#   docker build -t hemislam .
#   docker run --rm -p 8080:8080 -v "$PWD:/recordings" hemislam
#
# Outside 127.0.0.1 the page asks for a token: open the link that is printed.
FROM python:3.11-slim

# libgomp1: OpenMP for the kernels. The others: open3d, which only `hemislam simulate` loads.
RUN apt-get update \
 && apt-get install -y --no-install-recommends make libgomp1 libusb-1.0-0 libegl1 libgl1 \
 && rm -rf /var/lib/apt/lists/*

RUN useradd --create-home hemislam && install -d -o hemislam -g hemislam /recordings /hemislam
USER hemislam
WORKDIR /hemislam
COPY --chown=hemislam:hemislam . .
RUN make install PYTHON=python3

EXPOSE 8080
VOLUME /recordings
ENV PATH="/hemislam/.venv/bin:$PATH"
ENTRYPOINT ["hemislam"]
CMD ["serve", "--host", "0.0.0.0", "--no-browser", "--folder", "/recordings", "--folder", "sample_data"]
