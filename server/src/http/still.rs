//! A connection that is given up once it has stood still for too long, or takes too long to ask.
//!
//! HTTP's own timers see requests, and only once there is one. This one sees bytes, and is told of answers: nothing read
//! and nothing written for a while means that nobody is there, that nobody reads, or that somebody holds a place for
//! nothing. Bytes that come while no answer is under way are the head of a request, which has to end soon, however
//! often another byte of it comes. Over HTTP/2, where bytes may come at any time, what counts is how long nothing
//! was asked, or nobody took anything of the answers under way: pings go on whether anybody reads or not.

use super::limits::Limits;
use pin_project_lite::pin_project;
use std::io;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, ready};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::{Instant, Sleep, sleep_until};

/// What an HTTP/2 connection begins with.
const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";

/// Bytes that are written at once for an answer, and not to ping or to be polite.
const ANSWER_BYTES: usize = 1024;

/// What goes on on a connection.
#[derive(Debug)]
pub(super) struct Activity(Mutex<State>);

#[derive(Debug)]
struct State {
    /// When a byte was last read or written.
    moved: Instant,
    /// When the last answer ended, or the connection began.
    rested: Instant,
    /// When something of an answer was last taken, as far as that can be told.
    taken: Instant,
    /// Since when the head of a request is being read, over HTTP/1.
    head: Option<Instant>,
    /// When the answers under way began.
    answers: Vec<Instant>,
    /// How much of HTTP/2's preface has come; `None` where something else came.
    preface: Option<usize>,
}

impl Activity {
    pub(super) fn new() -> Arc<Self> {
        let now = Instant::now();
        let state =
            State { moved: now, rested: now, taken: now, head: None, answers: Vec::new(), preface: Some(0) };
        Arc::new(Self(Mutex::new(state)))
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The head of a request has been read, and its answer begins. It ends when what this returns is dropped.
    pub(super) fn begin(self: &Arc<Self>) -> Answering {
        let mut state = self.lock();
        let began = Instant::now();
        state.head = None;
        state.answers.push(began);
        drop(state);
        Answering { activity: Arc::clone(self), began }
    }

    fn read(&self, bytes: &[u8]) {
        let mut state = self.lock();
        state.moved = Instant::now();
        if let Some(seen) = state.preface
            && seen < PREFACE.len()
        {
            let rest = &PREFACE[seen..];
            let count = rest.len().min(bytes.len());
            state.preface = (rest[..count] == bytes[..count]).then_some(seen + count);
        }
        if state.answers.is_empty() && !state.is_http_2() && !bytes.is_empty() {
            state.head = state.head.or(Some(state.moved));
        }
    }

    fn wrote(&self, bytes: usize) {
        let mut state = self.lock();
        state.moved = Instant::now();
        if bytes >= ANSWER_BYTES {
            state.taken = state.moved;
        }
    }

    /// When the connection is to be given up, if nothing happens before.
    fn due(&self, patience: &Patience) -> Instant {
        let state = self.lock();
        let still = state.moved + patience.still;
        match state.answers.iter().min() {
            Some(oldest) => {
                let due = still.min(*oldest + patience.answer);
                // What is asked meanwhile says nothing of whether answers are read.
                let taken = state.taken.max(*oldest) + patience.still;
                if state.is_http_2() { due.min(taken) } else { due }
            }
            None if state.is_http_2() => still.min(state.rested + patience.still),
            None => state.head.map_or_else(
                // The last bytes of an answer may still be on their way.
                || still.min(state.rested + patience.answer),
                |since| still.min(since + patience.head),
            ),
        }
    }
}

impl State {
    fn is_http_2(&self) -> bool {
        self.preface == Some(PREFACE.len())
    }
}

/// An answer under way.
#[derive(Debug)]
pub(super) struct Answering {
    activity: Arc<Activity>,
    began: Instant,
}

impl Answering {
    /// Another part of it was taken, to be written.
    pub(super) fn goes_on(&self) {
        self.activity.lock().taken = Instant::now();
    }
}

impl Drop for Answering {
    fn drop(&mut self) {
        let mut state = self.activity.lock();
        state.rested = Instant::now();
        state.taken = state.rested;
        if let Some(position) = state.answers.iter().position(|began| *began == self.began) {
            state.answers.swap_remove(position);
        }
    }
}

/// How long a connection may take for what.
#[derive(Debug, Clone, Copy)]
pub(super) struct Patience {
    still: Duration,
    head: Duration,
    answer: Duration,
}

impl From<&Limits> for Patience {
    fn from(limits: &Limits) -> Self {
        Self { still: limits.still, head: limits.head, answer: limits.answer }
    }
}

pin_project! {
    /// A connection whose reads and writes fail once [`Activity`] says that it is due.
    pub(super) struct Watched<T> {
        #[pin]
        inner: T,
        #[pin]
        alarm: Sleep,
        activity: Arc<Activity>,
        patience: Patience,
    }
}

impl<T> Watched<T> {
    pub(super) fn new(inner: T, activity: Arc<Activity>, patience: Patience) -> Self {
        let alarm = sleep_until(activity.due(&patience));
        Self { inner, alarm, activity, patience }
    }

    /// Whether the connection is due; if not, wakes the task once it is.
    fn is_due(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<()> {
        let mut this = self.project();
        loop {
            let due = this.activity.due(this.patience);
            // Set later only once it has rung: bytes come far more often.
            if this.alarm.deadline() > due {
                this.alarm.as_mut().reset(due);
            }
            ready!(this.alarm.as_mut().poll(context));
            if Instant::now() >= due {
                return Poll::Ready(());
            }
            this.alarm.as_mut().reset(due);
        }
    }

    /// Passes on what happened; if nothing did, fails once the connection is due.
    fn watch<R>(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        happened: Poll<io::Result<R>>,
    ) -> Poll<io::Result<R>> {
        if happened.is_pending() {
            ready!(self.is_due(context));
            return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
        }
        happened
    }

    fn written(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        happened: Poll<io::Result<usize>>,
    ) -> Poll<io::Result<usize>> {
        if let Poll::Ready(written) = &happened {
            self.activity.wrote(*written.as_ref().unwrap_or(&0));
        }
        self.watch(context, happened)
    }
}

impl<T: AsyncRead> AsyncRead for Watched<T> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let before = buffer.filled().len();
        let read = self.as_mut().project().inner.poll_read(context, buffer);
        if read.is_ready() {
            self.activity.read(&buffer.filled()[before..]);
            // Many small bytes, one after another, never let a read wait.
            if self.activity.due(&self.patience) <= Instant::now() {
                return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
            }
        }
        self.watch(context, read)
    }
}

impl<T: AsyncWrite> AsyncWrite for Watched<T> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let written = self.as_mut().project().inner.poll_write(context, bytes);
        self.written(context, written)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = self.as_mut().project().inner.poll_write_vectored(context, bytes);
        self.written(context, written)
    }

    fn is_write_vectored(&self) -> bool {
        self.inner.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        let flushed = self.as_mut().project().inner.poll_flush(context);
        self.watch(context, flushed)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        let shut = self.as_mut().project().inner.poll_shutdown(context);
        self.watch(context, shut)
    }
}

pin_project! {
    /// A connection below its encryption, where bytes are seen to leave that above wait to be flushed. What comes is
    /// not noted: bits of what is not yet a byte above are nothing.
    pub(super) struct Noted<T> {
        #[pin]
        inner: T,
        activity: Arc<Activity>,
    }
}

impl<T> Noted<T> {
    pub(super) fn new(inner: T, activity: Arc<Activity>) -> Self {
        Self { inner, activity }
    }

    fn written(&self, happened: Poll<io::Result<usize>>) -> Poll<io::Result<usize>> {
        if let Poll::Ready(written) = &happened {
            self.activity.wrote(*written.as_ref().unwrap_or(&0));
        }
        happened
    }
}

impl<T: AsyncRead> AsyncRead for Noted<T> {
    fn poll_read(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        self.project().inner.poll_read(context, buffer)
    }
}

impl<T: AsyncWrite> AsyncWrite for Noted<T> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let written = self.as_mut().project().inner.poll_write(context, bytes);
        self.written(written)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = self.as_mut().project().inner.poll_write_vectored(context, bytes);
        self.written(written)
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
    use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream, duplex};
    use tokio::time::{sleep, timeout};

    const fn milliseconds(count: u64) -> Duration {
        Duration::from_millis(count)
    }

    const PATIENCE: Patience =
        Patience { still: milliseconds(1000), head: milliseconds(300), answer: milliseconds(2500) };

    /// Time stands still but for what is waited for.
    fn run(test: impl Future<Output = ()>) {
        let mut builder = tokio::runtime::Builder::new_current_thread();
        builder.enable_all().start_paused(true).build().unwrap().block_on(test);
    }

    fn pair() -> (Watched<DuplexStream>, DuplexStream, Arc<Activity>) {
        let (near, far) = duplex(64);
        let activity = Activity::new();
        (Watched::new(near, Arc::clone(&activity), PATIENCE), far, activity)
    }

    /// Reads until the connection is given up, and says after how long.
    async fn given_up(near: Watched<DuplexStream>) -> Duration {
        let (mut near, started) = (std::pin::pin!(near), Instant::now());
        let error = loop {
            if let Err(error) = near.read(&mut [0; 64]).await {
                break error;
            }
        };
        assert_eq!(error.kind(), io::ErrorKind::TimedOut);
        started.elapsed()
    }

    fn assert_after(found: Duration, least: u64) {
        assert!(
            found >= milliseconds(least) && found < milliseconds(least + 100),
            "{found:?}, not {least} ms"
        );
    }

    /// Sends bytes now and then, as long as the other side is there.
    async fn dribble(mut far: DuplexStream, first: &[u8]) {
        let mut bytes = first;
        while far.write_all(bytes).await.is_ok() {
            sleep(milliseconds(50)).await;
            bytes = b"x";
        }
    }

    #[test]
    fn who_neither_sends_nor_reads_is_given_up() {
        run(async {
            let (near, _far, _) = pair();
            assert_after(given_up(near).await, 1000);
            let (near, _far, _activity) = pair();
            let mut near = std::pin::pin!(near);
            near.write_all(&[0; 64]).await.unwrap();
            assert_eq!(near.write_all(b"more").await.unwrap_err().kind(), io::ErrorKind::TimedOut);
        });
    }

    #[test]
    fn a_head_that_comes_bit_by_bit_has_to_end() {
        run(async {
            let (near, far, _) = pair();
            let (found, ()) = tokio::join!(given_up(near), dribble(far, b"GET"));
            assert_after(found, 300);
        });
    }

    #[test]
    fn pings_do_not_keep_answers_that_nobody_reads() {
        run(async {
            let (near, mut far, activity) = pair();
            let (mut near, mut bytes) = (std::pin::pin!(near), [0; 64]);
            far.write_all(PREFACE).await.unwrap();
            assert_eq!(near.read(&mut bytes).await.unwrap(), PREFACE.len());
            let first = activity.begin();
            for _ in 0..3 {
                // Pings go out, and now and then something of the answer.
                for _ in 0..2 {
                    sleep(milliseconds(400)).await;
                    near.write_all(b"ping").await.unwrap();
                    far.read_exact(&mut bytes[..4]).await.unwrap();
                }
                first.goes_on();
            }
            // Nor does what is asked meanwhile.
            let others = [activity.begin(), activity.begin()];
            for _ in 0..2 {
                sleep(milliseconds(400)).await;
                near.write_all(b"ping").await.unwrap();
            }
            sleep(milliseconds(300)).await;
            assert_eq!(near.write_all(b"ping").await.map_err(|e| e.kind()), Ok(()), "who can write writes");
            assert_eq!(near.read(&mut bytes).await.unwrap_err().kind(), io::ErrorKind::TimedOut);
            drop((first, others));
        });
    }

    #[test]
    fn who_has_been_answered_may_wait_before_asking_again() {
        run(async {
            let (near, mut far, activity) = pair();
            let (mut near, mut bytes) = (std::pin::pin!(near), [0; 64]);
            for _ in 0..3 {
                far.write_all(b"GET").await.unwrap();
                assert_eq!(near.read(&mut bytes).await.unwrap(), 3);
                drop(activity.begin());
                // Longer than a head may take.
                let waited = timeout(milliseconds(900), near.read(&mut bytes)).await;
                assert!(waited.is_err(), "{waited:?}");
            }
            // What begins late has all the time of a head again.
            far.write_all(b"G").await.unwrap();
            assert_eq!(near.read(&mut bytes).await.unwrap(), 1);
            assert!(timeout(milliseconds(290), near.read(&mut bytes)).await.is_err());
            assert!(near.read(&mut bytes).await.is_err());
        });
    }

    #[test]
    fn an_answer_ends_in_time_however_it_is_read() {
        run(async {
            let (near, far, activity) = pair();
            let _answering = activity.begin();
            let (found, ()) = tokio::join!(given_up(near), dribble(far, b"x"));
            assert_after(found, 2500);
        });
    }

    #[test]
    fn over_http_2_bytes_alone_are_no_requests() {
        run(async {
            let (near, far, activity) = pair();
            let begun = async {
                sleep(milliseconds(500)).await;
                drop(activity.begin());
            };
            let (found, (), ()) = tokio::join!(given_up(near), dribble(far, PREFACE), begun);
            assert_after(found, 1500);
        });
    }
}
