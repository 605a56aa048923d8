//! Write timeout of a connection: it fails when the peer accepts no byte for a while.
//!
//! TCP has no such limit. A peer that stops reading would hold the connection and its buffers for ever.

use std::io::{Error, ErrorKind, IoSlice, Result};
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::{Instant, Sleep, sleep};

/// See the head of the file.
pub(crate) struct WriteLimit<T> {
    inner: T,
    patience: Duration,
    /// Deadline of the pending write; `None` if no write is pending.
    limit: Option<Pin<Box<Sleep>>>,
}

impl<T> WriteLimit<T> {
    /// Returns `inner`, whose writes fail with [`ErrorKind::TimedOut`] once the peer has taken no byte
    /// for `patience`. Time in which nothing is to be written does not count.
    pub(crate) fn new(inner: T, patience: Duration) -> WriteLimit<T> {
        WriteLimit { inner, patience, limit: None }
    }

    /// Passes a write's result on; fails a write that is pending beyond the deadline.
    fn judge<R>(&mut self, written: Poll<Result<R>>, context: &mut Context<'_>) -> Poll<Result<R>> {
        if written.is_ready() {
            self.limit = None;
            return written;
        }
        let limit = self.limit.get_or_insert_with(|| Box::pin(sleep(self.patience)));
        if limit.as_mut().poll(context).is_pending() {
            return Poll::Pending;
        }
        // Another try fails at once.
        limit.as_mut().reset(Instant::now());
        Poll::Ready(Err(Error::new(ErrorKind::TimedOut, "the peer reads nothing")))
    }
}

impl<T: AsyncRead + Unpin> AsyncRead for WriteLimit<T> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<Result<()>> {
        Pin::new(&mut self.inner).poll_read(context, buffer)
    }
}

impl<T: AsyncWrite + Unpin> AsyncWrite for WriteLimit<T> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<Result<usize>> {
        let written = Pin::new(&mut self.inner).poll_write(context, bytes);
        self.judge(written, context)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        parts: &[IoSlice<'_>],
    ) -> Poll<Result<usize>> {
        let written = Pin::new(&mut self.inner).poll_write_vectored(context, parts);
        self.judge(written, context)
    }

    fn is_write_vectored(&self) -> bool {
        self.inner.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Result<()>> {
        Pin::new(&mut self.inner).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Result<()>> {
        Pin::new(&mut self.inner).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::io::{AsyncReadExt, AsyncWriteExt};

    const PATIENCE: Duration = Duration::from_secs(60);

    #[tokio::test(start_paused = true)]
    async fn peer_that_stops_reading_loses_its_connection() {
        let (ours, mut theirs) = tokio::io::duplex(100);
        let mut ours = WriteLimit::new(ours, PATIENCE);
        let began = Instant::now();
        let (sent, read) = tokio::join!(ours.write_all(&[7; 1000]), async {
            let mut some = [0; 50];
            theirs.read_exact(&mut some).await
        });
        assert_eq!(sent.expect_err("nobody reads the rest").kind(), ErrorKind::TimedOut);
        read.expect("it came");
        assert_eq!(began.elapsed().as_secs(), 60);
        let again = ours.write(&[7]).await.expect_err("it stays so");
        assert_eq!(again.kind(), ErrorKind::TimedOut);
    }

    #[tokio::test(start_paused = true)]
    async fn slow_peer_gets_all_in_its_time() {
        let (ours, mut theirs) = tokio::io::duplex(100);
        let mut ours = WriteLimit::new(ours, PATIENCE);
        let began = Instant::now();
        let reading = async {
            let mut all = Vec::new();
            while all.len() < 1000 {
                tokio::time::sleep(Duration::from_secs(50)).await;
                let mut some = [0; 100];
                let n = theirs.read(&mut some).await.expect("it is there");
                all.extend_from_slice(&some[..n]);
            }
            all.len()
        };
        let (sent, read) = tokio::join!(ours.write_all(&[7; 1000]), reading);
        sent.expect("a byte was taken every 50 s");
        assert_eq!((read, began.elapsed().as_secs()), (1000, 500));
        // A connection at rest waits for as long as it likes.
        tokio::time::sleep(PATIENCE * 10).await;
        ours.write_all(&[8; 50]).await.expect("there is room");
    }
}
