"""Uploads that go to S3 directly, part by part, with URLs that the server signs (S3's multipart uploads)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from app.errors import InvalidParameter, Unavailable

PART_BYTES = 64 * 1024**2
"""Size of each part but the last. [byte] Chosen by hand; S3 allows 5 MiB to 5 GiB, and 10,000 parts."""


class S3Parts:
    """Multipart uploads of an S3 bucket; credentials and endpoint come from AWS_* variables.

    Parameters
    ----------
    url : str
        Of the blob store.
    """

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        self._bucket = parts.netloc if parts.scheme == "s3" else ""
        self._prefix = parts.path.strip("/")
        self._made: Any = None

    def start(self, key: str) -> str:
        """Begin an upload of a blob; returns its id in S3.

        Raises
        ------
        InvalidParameter
            The blobs are in a folder.
        Unavailable
            S3 does not answer, or the extra s3 is not installed.
        """
        if not self._bucket:
            raise InvalidParameter(
                "this server stores files in a folder, to which no parts can be sent directly",
                field="method",
                limit="tus",
                cure="upload by tus 1.0: POST /v1/uploads with the header Tus-Resumable: 1.0.0",
            )
        with _answering():
            answer: str = self._client().create_multipart_upload(Bucket=self._bucket, Key=self._name(key))["UploadId"]
        return answer

    def sign(self, key: str, upload_id: str, count: int, valid_s: int) -> list[str]:
        """URLs to which the parts are sent by PUT, in their order."""
        where = {"Bucket": self._bucket, "Key": self._name(key), "UploadId": upload_id}
        sign = self._client().generate_presigned_url
        return [
            sign("upload_part", Params={**where, "PartNumber": number}, ExpiresIn=valid_s)
            for number in range(1, count + 1)
        ]

    def complete(self, key: str, upload_id: str, etags: Sequence[str]) -> None:
        """Make the parts one blob; one that was completed before stays as it is.

        Raises
        ------
        InvalidParameter
            A part is missing, or has another ETag.
        """
        from botocore.exceptions import ClientError  # type: ignore[import-untyped]

        parts = [{"PartNumber": number, "ETag": etag} for number, etag in enumerate(etags, 1)]
        with _answering():
            try:
                self._client().complete_multipart_upload(
                    Bucket=self._bucket, Key=self._name(key), UploadId=upload_id, MultipartUpload={"Parts": parts}
                )
            except ClientError as error:
                code = error.response["Error"]["Code"]
                if code == "NoSuchUpload":
                    return  # whether there is a blob shows when it is opened
                if code in ("InvalidPart", "InvalidPartOrder", "EntityTooSmall"):
                    raise InvalidParameter(
                        f"S3 does not accept the parts ({code})", field="etags", cure="send all parts again"
                    ) from error
                raise

    def abort(self, key: str, upload_id: str) -> None:
        """Delete the parts of an upload that is given up."""
        from botocore.exceptions import ClientError

        with _answering():
            try:
                self._client().abort_multipart_upload(Bucket=self._bucket, Key=self._name(key), UploadId=upload_id)
            except ClientError as error:
                if error.response["Error"]["Code"] != "NoSuchUpload":
                    raise

    def _name(self, key: str) -> str:
        return f"{self._prefix}/{key}" if self._prefix else key

    def _client(self) -> Any:
        if self._made is None:
            try:
                import boto3  # type: ignore[import-untyped]
            except ImportError as error:
                raise Unavailable("the extra s3 is not installed", cure="pip install waymark-roads[s3]") from error
            self._made = boto3.client("s3")
        return self._made


@contextmanager
def _answering() -> Iterator[None]:
    """An S3 that fails or does not answer is `Unavailable`."""
    try:
        from botocore.exceptions import BotoCoreError, ClientError
    except ImportError as error:
        raise Unavailable("the extra s3 is not installed", cure="pip install waymark-roads[s3]") from error
    try:
        yield
    except (BotoCoreError, ClientError) as error:
        raise Unavailable("the blob store failed or does not answer", cure="try again in a few seconds") from error
