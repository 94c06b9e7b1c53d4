//! `zenoh-bridge-ros2dds -c FILE`: a Zenoh runtime with the ROS 2 plugin linked in.
//!
//! It takes the one option that the tests need, spelled as in the program of the same name that
//! the plugin's authors ship, so that either of them can stand in the same place.

use std::process::ExitCode;

use zenoh::{
    internal::{plugins::PluginsManager, runtime::RuntimeBuilder},
    Config, Result,
};

const USAGE: &str = "usage: zenoh-bridge-ros2dds -c FILE    (a Zenoh configuration, JSON5)";

async fn serve(mut config: Config) -> Result<()> {
    // The caches of transient-local topics need them, and only a router has them by itself. Without
    // them no action is routed: its status is such a topic.
    config.insert_json5("timestamping/enabled", "true")?;
    let mut plugins = PluginsManager::static_plugins_only();
    plugins.declare_static_plugin::<zenoh_plugin_ros2dds::ROS2Plugin, _>("ros2dds", true);
    let mut runtime = RuntimeBuilder::new(config).plugins_manager(plugins).build().await?;
    runtime.start().await?;
    tokio::signal::ctrl_c().await?;
    Ok(())
}

#[tokio::main]
async fn main() -> ExitCode {
    zenoh::init_log_from_env_or("warn");
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [option, file] = arguments.as_slice() else {
        eprintln!("{USAGE}");
        return ExitCode::from(2);
    };
    if option != "-c" {
        eprintln!("{USAGE}");
        return ExitCode::from(2);
    }
    let served = match Config::from_file(file) {
        Ok(config) => serve(config).await,
        Err(error) => Err(error),
    };
    match served {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("zenoh-bridge-ros2dds: {error}");
            ExitCode::FAILURE
        }
    }
}
