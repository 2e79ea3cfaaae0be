//! Work beside the frames: on threads, or, in a browser, between frames.
//!
//! The only place that knows of both. A browser gives a page one thread: what is done there in the background is cut
//! into slices of a few milliseconds, and requests are the browser's own.

use std::time::Duration;

/// Whether there are threads.
pub const HAS_THREADS: bool = !cfg!(target_arch = "wasm32");

#[cfg(not(target_arch = "wasm32"))]
mod driver {
    use std::time::Duration;

    /// What runs futures; they are dropped with it, without waiting.
    #[derive(Debug)]
    pub struct Background(Option<tokio::runtime::Runtime>);

    impl Background {
        /// Two threads of this name.
        ///
        /// # Errors
        /// When there are no more threads to be had.
        pub fn start(name: &str) -> std::io::Result<Self> {
            let mut builder = tokio::runtime::Builder::new_multi_thread();
            Ok(Self(Some(builder.worker_threads(2).thread_name(name).enable_all().build()?)))
        }

        /// Runs a future.
        pub fn spawn(&self, future: impl Future<Output = ()> + Send + 'static) {
            if let Some(runtime) = &self.0 {
                runtime.spawn(future);
            }
        }
    }

    impl Drop for Background {
        fn drop(&mut self) {
            if let Some(runtime) = self.0.take() {
                runtime.shutdown_background();
            }
        }
    }

    /// Runs a future to its end, whatever else is dropped, on a thread of its own.
    ///
    /// # Errors
    /// When there are no more threads to be had.
    pub fn aside(name: &str, future: impl Future<Output = ()> + Send + 'static) -> std::io::Result<()> {
        let builder = std::thread::Builder::new().name(name.to_owned());
        builder.spawn(move || pollster::block_on(future)).map(drop)
    }

    /// Waits; only in what a [`Background`] runs.
    pub async fn sleep(duration: Duration) {
        tokio::time::sleep(duration).await;
    }
}

#[cfg(target_arch = "wasm32")]
mod driver {
    use futures_util::future::{AbortHandle, abortable};
    use std::cell::RefCell;
    use std::time::Duration;
    use wasm_bindgen::JsCast;
    use wasm_bindgen_futures::{JsFuture, spawn_local};

    /// What runs futures; they are dropped with it, without waiting.
    #[derive(Debug)]
    pub struct Background(RefCell<Vec<AbortHandle>>);

    impl Background {
        /// Tasks of the page.
        ///
        /// # Errors
        /// Never.
        pub fn start(_: &str) -> std::io::Result<Self> {
            Ok(Self(RefCell::default()))
        }

        /// Runs a future.
        pub fn spawn(&self, future: impl Future<Output = ()> + 'static) {
            let (future, handle) = abortable(future);
            self.0.borrow_mut().push(handle);
            spawn_local(async {
                // That it was dropped is what was wanted.
                let _ = future.await;
            });
        }
    }

    impl Drop for Background {
        fn drop(&mut self) {
            for handle in self.0.get_mut() {
                handle.abort();
            }
        }
    }

    /// Runs a future to its end, whatever else is dropped.
    ///
    /// # Errors
    /// Never.
    pub fn aside(_: &str, future: impl Future<Output = ()> + 'static) -> std::io::Result<()> {
        spawn_local(future);
        Ok(())
    }

    /// Waits.
    pub async fn sleep(duration: Duration) {
        let milliseconds = i32::try_from(duration.as_millis()).unwrap_or(i32::MAX);
        let promise = js_sys::Promise::new(&mut |resolve, _| {
            let global = js_sys::global().unchecked_into::<web_sys::Window>();
            // A page that cannot wait is at its end.
            let _ = global.set_timeout_with_callback_and_timeout_and_arguments_0(&resolve, milliseconds);
        });
        // Never rejected.
        let _ = JsFuture::from(promise).await;
    }
}

pub use driver::{Background, aside, sleep};

/// What a future gives, if it does so in time; only in what a [`Background`] runs.
pub async fn within<T>(duration: Duration, future: impl Future<Output = T>) -> Option<T> {
    tokio::select! {
        biased;
        done = future => Some(done),
        () = sleep(duration) => None,
    }
}
