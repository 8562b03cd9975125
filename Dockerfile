# The same steps as on any machine: make install, hemislam serve.
#
#   docker build -t hemislam .
#   docker run --rm -p 8080:8080 -v "$PWD:/recordings" hemislam
#
# Outside 127.0.0.1 the page asks for a token: open the link that is printed. `make image-test` builds and runs this.
FROM python:3.11-slim

# What open3d needs, which only `hemislam simulate` loads.
RUN apt-get update \
 && apt-get install -y --no-install-recommends make libgomp1 libusb-1.0-0 libegl1 libgl1 \
 && rm -rf /var/lib/apt/lists/*

WORKDIR /hemislam
COPY . .
RUN make install PYTHON=python3

# Any user (`--user 12345`) may write results, but not change the program.
RUN useradd --create-home hemislam \
 && install -d -m 1777 /recordings /hemislam/runs
ENV PATH="/hemislam/.venv/bin:$PATH"
USER hemislam

EXPOSE 8080
VOLUME /recordings
ENTRYPOINT ["hemislam"]
CMD ["serve", "--host", "0.0.0.0", "--no-browser", "--folder", "/recordings", "--folder", "sample_data"]
