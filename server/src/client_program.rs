//! The client's program, which lies beside the server's: for pictures and flights, since only the client draws.

use std::path::PathBuf;
use std::process::Command;

/// There is no such program.
#[derive(Debug, thiserror::Error)]
#[error("{0}: not found; build the client beside the server: cargo build --release -p diamantina-client")]
pub struct NoClient(PathBuf);

/// Where the client's program lies.
///
/// # Errors
/// When it does not.
pub fn path() -> Result<PathBuf, NoClient> {
    let name = "diamantina-client";
    let beside = std::env::current_exe().map(|server| server.with_file_name(name));
    let path = beside.unwrap_or_else(|_| PathBuf::from(name));
    if path.exists() { Ok(path) } else { Err(NoClient(path)) }
}

/// A call of it, to which arguments are to be added.
///
/// # Errors
/// When it is not there.
pub fn command() -> Result<Command, NoClient> {
    let mut command = Command::new(path()?);
    if std::env::var_os("XDG_RUNTIME_DIR").is_none() {
        // Without a session Mesa's device selection complains on standard error, as if we had failed.
        command.env("NODEVICE_SELECT", "1");
    }
    Ok(command)
}
