"""A writer of logs in every format that can be read."""

import gzip

import numpy as np

from mmwave_env.datasets.log_folder import log_columns, log_text


def write_log(path, episode):
    """Write the log of an episode as CSV, gzipped CSV or Parquet, as the name of the file says."""
    columns = log_columns(episode)
    if path.suffix == ".parquet":
        import pyarrow
        from pyarrow import parquet

        arrays = {name: pyarrow.array(v, mask=np.isnan(v)) for name, v in columns.items()}
        parquet.write_table(pyarrow.table(arrays), path, write_page_checksum=True)
        return
    content = log_text(columns).encode()
    path.write_bytes(gzip.compress(content, mtime=0) if path.suffix == ".gz" else content)
