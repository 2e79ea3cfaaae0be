//! Bodies that the kernel takes from a file, and not from this process.
//!
//! A byte that is written to a socket is copied into the kernel. What lies in a file is not: the kernel sends the file's
//! own pages (`sendfile`). So blobs that are asked for again and again have a copy in a file that has no name and no disk
//! (`memfd_create`), made of what has been checked, and a [`Sender`] has the kernel take them from there. HTTP's code
//! above knows nothing of it: what it writes is a blob if it lies where the blob lies in memory.
//!
//! Pages may wait in a socket for long after the blob is forgotten, so none is ever written twice: each blob has a
//! place of its own behind all others, and leaves a hole there once it is gone. The file grows, its memory does not.
//!
//! Elsewhere than on Linux, and where the system gives no such file, all is written as usual.

use bytes::Bytes;
use prometheus_client::metrics::counter::Counter;
use std::fs::File;
use std::io::{self, IoSlice};
use std::pin::Pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, ready};
use tokio::io::{AsyncRead, AsyncWrite, Interest, ReadBuf};
use tokio::net::TcpStream;

pub(super) use system::outlive_limits;

/// Bytes from which on a blob is worth a call of the system of its own.
const LEAST: usize = 16 << 10;

/// Where blobs begin in the file: pages of all systems are of at most so many bytes.
const PAGE_MAX: u64 = 1 << 16;

/// Memory comes by the page.
pub(super) const PAGE: u64 = 4096;

/// The file.
#[derive(Debug)]
pub(super) struct Files {
    file: File,
    /// What lies behind is not in use.
    end: AtomicU64,
}

impl Files {
    /// A new one, if the system has such.
    pub(super) fn new() -> Option<Arc<Self>> {
        let made = system::create();
        if let Err(error) = &made {
            tracing::debug!(%error, "blobs are written as usual");
        }
        Some(Arc::new(Self { file: made.ok()?, end: AtomicU64::new(0) }))
    }

    /// A copy of a blob, if it is worth one.
    pub(super) fn put(self: &Arc<Self>, bytes: &Bytes) -> Option<Arc<Filed>> {
        if bytes.len() < LEAST {
            return None;
        }
        let room = (bytes.len() as u64).next_multiple_of(PAGE_MAX);
        let offset = self.end.fetch_add(room, Ordering::Relaxed);
        // Whatever comes of writing, what is written leaves a hole.
        let filed = Arc::new(Filed { files: Arc::clone(self), offset, bytes: bytes.clone() });
        match system::write(&self.file, bytes, offset) {
            Ok(()) => Some(filed),
            Err(error) => {
                tracing::warn!(%error, "no memory for a copy of a blob: it is written as usual");
                None
            }
        }
    }
}

/// A blob of which there is a copy in the file.
#[derive(Debug)]
pub(super) struct Filed {
    files: Arc<Files>,
    offset: u64,
    bytes: Bytes,
}

impl Filed {
    /// What the copy takes in memory.
    pub(super) fn weight(&self) -> u64 {
        (self.bytes.len() as u64).next_multiple_of(PAGE)
    }

    /// Where in the file these bytes are, if they are bytes of the blob, and not equal ones elsewhere.
    fn place(&self, bytes: &[u8]) -> Option<u64> {
        let [blob, part] = [&self.bytes[..], bytes].map(<[u8]>::as_ptr_range);
        let holds = !bytes.is_empty() && blob.start <= part.start && part.end <= blob.end;
        holds.then(|| self.offset + (part.start.addr() - blob.start.addr()) as u64)
    }

    /// Whether the blob's last byte is among the first `sent` of what was to be written.
    fn ends_with(&self, slices: &[IoSlice<'_>], at: usize, offset: u64, sent: usize) -> bool {
        let through: usize = slices[..=at].iter().map(|slice| slice.len()).sum();
        sent >= through && offset + slices[at].len() as u64 == self.offset + self.bytes.len() as u64
    }

    /// Sends what comes before the blob, and of the blob as much as the socket takes. Not all that is told may be sent, as
    /// always.
    fn send(
        &self,
        stream: &TcpStream,
        slices: &[IoSlice<'_>],
        at: usize,
        offset: u64,
        taken: &Counter,
    ) -> io::Result<usize> {
        let before: usize = slices[..at].iter().map(|slice| slice.len()).sum();
        if before > 0 {
            let sent = system::send_before(stream, &slices[..at])?;
            if sent < before {
                return Ok(sent);
            }
        }
        match system::send(stream, &self.files.file, offset, slices[at].len()) {
            Ok(sent) => {
                taken.inc_by(sent as u64);
                Ok(before + sent)
            }
            // The rest is told again, and fails again.
            Err(_) if before > 0 => Ok(before),
            Err(error) => Err(error),
        }
    }
}

impl Drop for Filed {
    fn drop(&mut self) {
        let room = (self.bytes.len() as u64).next_multiple_of(PAGE_MAX);
        if let Err(error) = system::forget(&self.files.file, self.offset, room) {
            tracing::warn!(%error, "the copy of a blob stays in memory");
        }
    }
}

/// What a connection is about to send.
#[derive(Debug, Default)]
pub(super) struct Outbox {
    expected: Mutex<Option<Arc<Filed>>>,
    /// Bytes that the kernel took.
    taken: Counter,
}

impl Outbox {
    /// One that counts the bytes which the kernel takes.
    pub(super) fn new(taken: Counter) -> Self {
        Self { taken, ..Self::default() }
    }

    fn lock(&self) -> MutexGuard<'_, Option<Arc<Filed>>> {
        self.expected.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The next answer is this blob. Answers before it that are still to be sent are written as usual.
    pub(super) fn expect(&self, filed: Arc<Filed>) {
        *self.lock() = Some(filed);
    }

    fn clear(&self) {
        *self.lock() = None;
    }

    /// The blob if it is among what is to be written, with which slice is the first of it, and where that is in the file.
    fn find(&self, slices: &[IoSlice<'_>]) -> Option<(Arc<Filed>, usize, u64)> {
        let expected = self.lock();
        let filed = expected.as_ref()?;
        let mut places = slices.iter().enumerate();
        let (at, offset) = places.find_map(|(at, slice)| Some((at, filed.place(slice)?)))?;
        Some((Arc::clone(filed), at, offset))
    }
}

/// A connection on which the kernel takes what its outbox holds from the file.
#[derive(Debug)]
pub(super) struct Sender {
    stream: TcpStream,
    outbox: Arc<Outbox>,
}

impl Sender {
    pub(super) fn new(stream: TcpStream, outbox: Arc<Outbox>) -> Self {
        Self { stream, outbox }
    }

    fn inner(self: Pin<&mut Self>) -> Pin<&mut TcpStream> {
        Pin::new(&mut self.get_mut().stream)
    }
}

impl AsyncRead for Sender {
    fn poll_read(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        self.inner().poll_read(context, buffer)
    }
}

impl AsyncWrite for Sender {
    fn poll_write(self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        self.poll_write_vectored(context, &[IoSlice::new(bytes)])
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let Some((filed, at, offset)) = self.outbox.find(slices) else {
            return self.inner().poll_write_vectored(context, slices);
        };
        loop {
            ready!(self.stream.poll_write_ready(context))?;
            let send = || filed.send(&self.stream, slices, at, offset, &self.outbox.taken);
            match self.stream.try_io(Interest::WRITABLE, send) {
                Ok(sent) => {
                    if filed.ends_with(slices, at, offset, sent) {
                        // Whoever asks for nothing more holds nothing.
                        self.outbox.clear();
                    }
                    return Poll::Ready(Ok(sent));
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                Err(error) => {
                    // Whatever it is, it is not to be worse than without.
                    tracing::debug!(%error, "a blob is written as usual");
                    self.outbox.clear();
                    return self.as_mut().inner().poll_write_vectored(context, slices);
                }
            }
        }
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.inner().poll_flush(context)
    }

    fn poll_shutdown(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.inner().poll_shutdown(context)
    }
}

#[cfg(target_os = "linux")]
mod system {
    use rustix::fs::{FallocateFlags, MemfdFlags};
    use rustix::net::{SendAncillaryBuffer, SendFlags};
    use std::fs::File;
    use std::io::{self, IoSlice};
    use std::os::fd::AsFd;
    use std::os::unix::fs::FileExt as _;

    /// Where no file may be larger than so much (`ulimit -f`), writing beyond is to fail, and not to end this process. That
    /// needs a handler, and so an async runtime.
    pub(in crate::http) fn outlive_limits() -> io::Result<()> {
        let number = rustix::process::Signal::XFSZ.as_raw();
        tokio::signal::unix::signal(tokio::signal::unix::SignalKind::from_raw(number)).map(drop)
    }

    pub(super) fn create() -> io::Result<File> {
        Ok(rustix::fs::memfd_create("diamantina blobs", MemfdFlags::CLOEXEC)?.into())
    }

    pub(super) fn write(file: &File, bytes: &[u8], offset: u64) -> io::Result<()> {
        file.write_all_at(bytes, offset)
    }

    pub(super) fn forget(file: &File, offset: u64, room: u64) -> io::Result<()> {
        Ok(rustix::fs::fallocate(file, FallocateFlags::PUNCH_HOLE | FallocateFlags::KEEP_SIZE, offset, room)?)
    }

    /// Sends what more will follow, in the same packet if it fits.
    pub(super) fn send_before(socket: impl AsFd, slices: &[IoSlice<'_>]) -> io::Result<usize> {
        let flags = SendFlags::MORE | SendFlags::NOSIGNAL;
        Ok(rustix::net::sendmsg(socket, slices, &mut SendAncillaryBuffer::default(), flags)?)
    }

    pub(super) fn send(socket: impl AsFd, file: &File, mut offset: u64, count: usize) -> io::Result<usize> {
        match rustix::fs::sendfile(socket, file, Some(&mut offset), count)? {
            0 => Err(io::ErrorKind::UnexpectedEof.into()),
            sent => Ok(sent),
        }
    }
}

#[cfg(not(target_os = "linux"))]
mod system {
    use std::fs::File;
    use std::io::{self, IoSlice};

    fn unsupported<T>() -> io::Result<T> {
        Err(io::ErrorKind::Unsupported.into())
    }

    pub(in crate::http) fn outlive_limits() -> io::Result<()> {
        Ok(())
    }

    pub(super) fn create() -> io::Result<File> {
        unsupported()
    }

    pub(super) fn write(_: &File, _: &[u8], _: u64) -> io::Result<()> {
        unsupported()
    }

    pub(super) fn forget(_: &File, _: u64, _: u64) -> io::Result<()> {
        unsupported()
    }

    pub(super) fn send_before<S>(_: S, _: &[IoSlice<'_>]) -> io::Result<usize> {
        unsupported()
    }

    pub(super) fn send<S>(_: S, _: &File, _: u64, _: usize) -> io::Result<usize> {
        unsupported()
    }
}

#[cfg(test)]
#[cfg(target_os = "linux")]
mod tests {
    use super::*;
    use std::time::Duration;
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
    use tokio::net::TcpListener;

    fn blob(seed: u8, length: usize) -> Bytes {
        (0..length).map(|i| seed.wrapping_add((i % 251).to_le_bytes()[0])).collect::<Vec<u8>>().into()
    }

    async fn pair(outbox: &Arc<Outbox>) -> (Sender, TcpStream) {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let near = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
        let (far, _) = listener.accept().await.unwrap();
        (Sender::new(near, Arc::clone(outbox)), far)
    }

    fn run(test: impl Future<Output = ()>) {
        tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap().block_on(test);
    }

    /// Pages that the file has.
    fn kept(files: &Files) -> u64 {
        use std::os::unix::fs::MetadataExt as _;
        files.file.metadata().unwrap().blocks() * 512
    }

    #[test]
    fn a_blob_and_its_head_arrive_as_they_were_however_slowly_they_are_read() {
        run(async {
            let (files, outbox) = (Files::new().unwrap(), Arc::new(Outbox::default()));
            let (mut near, mut far) = pair(&outbox).await;
            for (seed, length) in [(1, LEAST), (2, 70_000), (3, 9 << 20), (4, 20_001)] {
                let (head, body, tail) = (blob(seed + 100, 77), blob(seed, length), blob(seed + 50, 9));
                outbox.expect(files.put(&body).unwrap());
                let expected = [&head[..], &body, &tail].concat();
                let write = async {
                    let mut parts = [head.clone(), body.clone(), tail.clone()];
                    while parts.iter().any(|part| !part.is_empty()) {
                        let slices = parts.each_ref().map(|part| IoSlice::new(part));
                        let mut sent = near.write_vectored(&slices).await.unwrap();
                        for part in &mut parts {
                            let gone = sent.min(part.len());
                            drop(part.split_to(gone));
                            sent -= gone;
                        }
                    }
                };
                let read = async {
                    let mut found = vec![0; expected.len()];
                    for piece in found.chunks_mut(1 << 20) {
                        tokio::time::sleep(Duration::from_millis(3)).await;
                        far.read_exact(piece).await.unwrap();
                    }
                    found
                };
                let ((), found) = tokio::join!(write, read);
                assert!(found == expected, "blob of {length}");
                assert!(outbox.lock().is_none(), "a blob that was sent is held");
            }
        });
    }

    #[test]
    fn what_waits_in_a_socket_stays_as_it_is_when_the_blob_is_forgotten() {
        run(async {
            let (files, outbox) = (Files::new().unwrap(), Arc::new(Outbox::default()));
            let (mut near, mut far) = pair(&outbox).await;
            let body = blob(1, 50_000);
            outbox.expect(files.put(&body).unwrap());
            assert!(kept(&files) >= 50_000);
            assert_eq!(near.write(&body).await.unwrap(), body.len());
            // Nobody holds it any more.
            assert_eq!(kept(&files), 0);
            let others: Vec<_> = (2..40).map(|seed| files.put(&blob(seed, 50_000)).unwrap()).collect();
            let mut found = vec![0; body.len()];
            far.read_exact(&mut found).await.unwrap();
            assert!(found == body);
            drop(others);
            assert_eq!(kept(&files), 0);
        });
    }

    #[test]
    fn a_blob_is_known_by_where_it_lies_and_small_ones_are_left() {
        let files = Files::new().unwrap();
        assert!(files.put(&blob(1, LEAST - 1)).is_none());
        files.put(&blob(2, 20_000)).unwrap();
        let body = blob(3, 20_000);
        let filed = files.put(&body).unwrap();
        assert_eq!((filed.offset, filed.weight()), (PAGE_MAX, 20_480));
        assert_eq!(filed.place(&body[17..]), Some(PAGE_MAX + 17));
        assert_eq!(filed.place(&Bytes::copy_from_slice(&body)), None);
        assert_eq!(filed.place(&body[5..5]), None);
    }

    #[test]
    fn a_copy_that_is_not_there_is_no_reason_not_to_send() {
        run(async {
            let (files, outbox) = (Files::new().unwrap(), Arc::new(Outbox::default()));
            let (mut near, mut far) = pair(&outbox).await;
            let body = blob(1, 50_000);
            outbox.expect(files.put(&body).unwrap());
            files.file.set_len(0).unwrap();
            near.write_all(&body).await.unwrap();
            let mut found = vec![0; body.len()];
            far.read_exact(&mut found).await.unwrap();
            assert!(found == body);
        });
    }
}
