# For people without Python 3.11 on Linux: notebooks, commands and trained policies in one image. Binder takes it too.
#   docker build -t lunar-rescue . && docker run -p 8888:8888 lunar-rescue
#   docker run -v "$PWD/out:/home/jovyan/lunar-rescue/results/batch" lunar-rescue reproduce batch --preset smoke
FROM python:3.11-slim-bookworm

RUN apt-get update \
 && apt-get install -y --no-install-recommends git make \
 && rm -rf /var/lib/apt/lists/*

# Binder starts containers as this user.
ARG NB_USER=jovyan
ARG NB_UID=1000
ENV USER=${NB_USER} HOME=/home/${NB_USER}
RUN useradd --create-home --uid ${NB_UID} ${NB_USER}

WORKDIR ${HOME}/lunar-rescue
COPY requirements.lock ./
# The CPU build of the version that the lock pins; the index serves PyTorch alone.
RUN pip install --no-cache-dir torch==$(sed -n 's/^torch==//p' requirements.lock) \
      --index-url https://download.pytorch.org/whl/cpu \
 && pip install --no-cache-dir -r requirements.lock
COPY --chown=${NB_UID} . .
RUN pip install --no-cache-dir --no-deps --no-build-isolation -e . && chown -R ${NB_UID} ${HOME}
USER ${NB_USER}

EXPOSE 8888
CMD ["jupyter", "lab", "--ip=0.0.0.0", "--no-browser", "notebooks"]
