//! Geometry, encodings and messages shared by server and client.
