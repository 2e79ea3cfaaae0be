//! A connection that is given up once it has stood still for too long.
//!
//! HTTP's own timers see requests, and only once there is one. This one sees bytes: nothing read and nothing written for a
//! while means that nobody is there, that nobody reads, or that somebody holds a place for nothing.

use pin_project_lite::pin_project;
use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::{Instant, Sleep, sleep_until};

pin_project! {
    /// A connection whose reads and writes fail after `patience` without a byte either way.
    pub(super) struct Watched<T> {
        #[pin]
        inner: T,
        #[pin]
        alarm: Sleep,
        moved: Instant,
        patience: Duration,
    }
}

impl<T> Watched<T> {
    pub(super) fn new(inner: T, patience: Duration) -> Self {
        let moved = Instant::now();
        Self { inner, alarm: sleep_until(moved + patience), moved, patience }
    }

    /// Passes on what happened; if nothing did, fails once that has lasted too long.
    fn noted<R>(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        happened: Poll<io::Result<R>>,
    ) -> Poll<io::Result<R>> {
        let mut this = self.project();
        if happened.is_ready() {
            *this.moved = Instant::now();
            return happened;
        }
        let due = *this.moved + *this.patience;
        // Set only now and then: bytes come far more often than the alarm.
        if this.alarm.deadline() < due {
            this.alarm.as_mut().reset(due);
        }
        ready!(this.alarm.poll(context));
        Poll::Ready(Err(io::ErrorKind::TimedOut.into()))
    }
}

impl<T: AsyncRead> AsyncRead for Watched<T> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let read = self.as_mut().project().inner.poll_read(context, buffer);
        self.noted(context, read)
    }
}

impl<T: AsyncWrite> AsyncWrite for Watched<T> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let written = self.as_mut().project().inner.poll_write(context, bytes);
        self.noted(context, written)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = self.as_mut().project().inner.poll_write_vectored(context, bytes);
        self.noted(context, written)
    }

    fn is_write_vectored(&self) -> bool {
        self.inner.is_write_vectored()
    }

    fn poll_flush(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.project().inner.poll_flush(context)
    }

    fn poll_shutdown(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.project().inner.poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::io::{AsyncReadExt, AsyncWriteExt, duplex};

    const PATIENCE: Duration = Duration::from_millis(200);

    fn run(test: impl Future<Output = ()>) {
        tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap().block_on(test);
    }

    #[test]
    fn who_neither_sends_nor_reads_is_given_up() {
        run(async {
            let (near, mut far) = duplex(64);
            let mut near = std::pin::pin!(Watched::new(near, PATIENCE));
            // As long as something comes now and then, all is well.
            for _ in 0..4 {
                tokio::time::sleep(PATIENCE / 2).await;
                far.write_all(b"x").await.unwrap();
                assert_eq!(near.read(&mut [0; 8]).await.unwrap(), 1);
            }
            assert_eq!(near.read(&mut [0; 8]).await.unwrap_err().kind(), io::ErrorKind::TimedOut);
        });
        run(async {
            let (near, _far) = duplex(64);
            let mut near = std::pin::pin!(Watched::new(near, PATIENCE));
            near.write_all(&[0; 64]).await.unwrap();
            assert_eq!(near.write_all(b"more").await.unwrap_err().kind(), io::ErrorKind::TimedOut);
        });
    }
}
